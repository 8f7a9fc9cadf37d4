"""Four scenes at two scales one after the other, and as jobs of dask on two worker processes, some of which are killed.

    python benchmarks/farm.py DATA

DATA holds `checkpoints/bases` and `checkpoints/flowers_r8`. Whole commands, two cores; every job has one thread. Then the same while workers
are killed with SIGKILL at random moments, until `kills` were: each command has to end with all files, of the same bytes. Writes farm.json
and farm.md.
"""

from __future__ import annotations

import hashlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import tyro

from mipmap_plugin.formats.atomic import write_json

RESULTS = Path(__file__).parent / "results"
SCENES = ("bases/lego_100", "bases/lego_200", "bases/chair_100", "flowers_r8")

# The longest pause, in seconds, between two kills.
PAUSE = 12.0


def main(data: tyro.conf.Positional[Path], kills: int = 20, seed: int = 0, output: Path = RESULTS) -> None:
    """Measure, and write the page.

    Args:
        data: The folder with checkpoints/.
        kills: Workers that are killed in all.
        seed: Of the moments and the victims.
        output: Where the results go.
    """
    scenes = [str(data.resolve() / "checkpoints" / scene) for scene in SCENES]
    serial, dask = (adapted(scenes, options) for options in (["--jobs", "1"], ["--dask", "local:2"]))
    chance, disturbed = random.Random(seed), []
    while sum(run["kills"] for run in disturbed) < kills:
        disturbed.append(adapted(scenes, ["--dask", "local:2"], chance, kills - sum(run["kills"] for run in disturbed)))
        print(f"{disturbed[-1]['kills']} killed, {disturbed[-1]['seconds']:.0f} s", flush=True)
    same = [run["files"] == serial["files"] for run in (dask, *disturbed)]
    write_json(output / "farm.json", {"serial": serial, "dask": dask, "disturbed": disturbed}, overwrite=True)
    (output / "farm.md").write_text(page(serial, dask, disturbed, same), encoding="utf-8")


def adapted(scenes: list[str], options: list[str], chance: random.Random | None = None, most: int = 0) -> dict[str, Any]:
    """Run the command; return its seconds, the hashes of its files, and how many workers were killed meanwhile."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["adapt", *scenes, "--scale", "1/2", "--scale", "1/4", "--threads", "1", "--output", folder, "--quiet", *options]
        began = time.perf_counter()
        process = subprocess.Popen([sys.executable, "-m", "mipmap_plugin", *words], stdout=subprocess.DEVNULL)
        killed: list[float] = []
        killer = threading.Thread(target=kill_workers, args=(process, chance, most, killed), daemon=True) if chance else None
        if killer:
            killer.start()
        code = process.wait()
        seconds = time.perf_counter() - began
        if killer:
            killer.join()
        files = {str(path.relative_to(folder)): digest(path) for path in sorted(Path(folder).rglob("*.ply"))}
    return {"seconds": seconds, "code": code, "kills": len(killed), "files": files}


def digest(path: Path) -> str:
    """The hash of a PLY's rows: its header has the time that the run took."""
    content = path.read_bytes()
    return hashlib.sha256(content[content.index(b"end_header\n") :]).hexdigest()


def kill_workers(process: subprocess.Popen[bytes], chance: random.Random, most: int, killed: list[float]) -> None:
    """Kill workers at random moments, as long as the command runs."""
    began = time.perf_counter()
    while process.poll() is None and len(killed) < most:
        if victims := workers_of(process.pid):
            with suppress(ProcessLookupError):  # it has ended
                os.kill(chance.choice(victims), signal.SIGKILL)
                killed.append(time.perf_counter() - began)
        time.sleep(chance.uniform(0, PAUSE))


def workers_of(parent: int) -> list[int]:
    """The processes that dask's nannies, which live in `parent`, have started."""
    children = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rsplit(")", 1)[1].split()
            words = (status.parent / "cmdline").read_bytes()
        except OSError:  # it has ended
            continue
        if int(fields[1]) == parent and fields[0] != "Z" and b"spawn_main" in words:
            children.append(int(status.parent.name))
    return children


def page(serial: dict[str, Any], dask: dict[str, Any], disturbed: list[dict[str, Any]], same: list[bool]) -> str:
    """What was found."""
    killed = [("the same, killed", *each) for each in zip(disturbed, same[1:], strict=True)]
    rows = [("one after the other", serial, ""), ("`--dask local:2`", dask, same[0]), *killed]
    lines = [
        "# Many scenes on several processes", "",
        "`python benchmarks/farm.py DATA`: lego_100, lego_200, chair_100 and flowers_r8 at x1/2 and x1/4, two cores, one thread each.", "",
        "| run | seconds | workers killed | exit code | files | same bytes |", "|---|---|---|---|---|---|",
        *(f"| {name} | {run['seconds']:.0f} | {run['kills']} | {run['code']} | {len(run['files'])} | {known} |" for name, run, known in rows),
        "", f"On two workers {serial['seconds'] / dask['seconds']:.2f} times as fast.", "",
    ]  # fmt: skip
    return "\n".join(lines)


if __name__ == "__main__":
    tyro.cli(main)
