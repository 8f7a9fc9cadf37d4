"""How long a person waits: whole commands, by phase, from a cold and a warm start, on one thread and on two, beside another version of the project.

    python benchmarks/wait.py DATA
    python benchmarks/wait.py DATA --before ../checkout-of-the-version-before --scale 1/4
    python benchmarks/wait.py DATA --before ../checkout-of-the-version-before --steps 1/4=290

DATA holds `checkpoints/bases/lego_200`. Each command is a process of its own, the versions take turns, and of several runs the quickest counts.
*cold* is the first run after installation, with an empty cache of compiled kernels. Writes wait.json and wait.md.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import tyro

from mipmap_plugin.formats.atomic import write_json

HERE = Path(__file__).parents[1]
PHASES = ("compilation", "blend weights", "merging", "closed form", "pseudo truth", "optimization", "validation")
INTRO = """# How long a person waits

Made by `python benchmarks/wait.py DATA`: seconds of whole processes, the quickest of {runs}, and until their first line; the phases of the report
of the same run. Two cores.
*before*: the version given by `--before`.
"""


def main(
    data: tyro.conf.Positional[Path],
    before: Path | None = None,
    scale: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    steps: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    runs: int = 2,
    output: Path = HERE / "benchmarks" / "results",
) -> None:
    """Measure, and write the tables.

    Args:
        data: The folder with checkpoints/.
        before: A checkout of another version, to be measured beside this one.
        scale: Scales to adapt lego_200 to; 1/2, 1/4 and 1/8 by default.
        steps: SCALE=STEPS: also adapt with so many steps, such as end with the dB of the version before.
        runs: Runs of each, of which the quickest counts.
        output: Where the results go.
    """
    versions = {"now": HERE} | ({"before": before.resolve()} if before else {})
    base = data.resolve() / "checkpoints" / "bases" / "lego_200"
    rows: list[dict[str, Any]] = []
    for what, options in commands(base, scale or ("1/2", "1/4", "1/8"), steps):
        for threads in (1, 2) if "adapt" in what else (1,):
            quickest: dict[str, dict[str, Any]] = {}
            for _ in range(1 if "cold" in what else runs):
                for version, checkout in versions.items() if "--steps" not in options else [("now", HERE)]:
                    row = {"command": what, "version": version, "threads": threads, **timed(checkout, options, threads, cold="cold" in what)}
                    quickest[version] = min(quickest.get(version, row), row, key=lambda measured: measured["seconds"])
            rows += quickest.values()
            print("\n".join(map(line, quickest.values())), flush=True)
    write_json(output / "wait.json", rows, overwrite=True)
    head = f"| command | version | threads | seconds | first line | {' | '.join(PHASES)} |\n|{'---|' * (5 + len(PHASES))}"
    (output / "wait.md").write_text("\n".join([INTRO.format(runs=runs), head, *map(line, rows), ""]))


def commands(base: Path, scales: tuple[str, ...], fewer: tuple[str, ...]) -> list[tuple[str, list[str]]]:
    """What is run, and its options."""
    adapt = {scale: ["adapt", str(base), "--scale", scale, "--json"] for scale in (*scales, "1/8", *(each.split("=")[0] for each in fewer))}
    return [
        ("--help", ["--help"]),
        ("inspect lego_200", ["inspect", str(base)]),
        *((f"adapt lego_200 x{scale}", adapt[scale]) for scale in scales),
        *((f"adapt lego_200 x{scale}, {steps} steps", [*adapt[scale], "--steps", steps]) for scale, steps in (each.split("=") for each in fewer)),
        ("adapt lego_200 x1/8, cold", adapt["1/8"]),
    ]


def timed(checkout: Path, options: list[str], threads: int, *, cold: bool) -> dict[str, Any]:
    """Seconds of one process, until its first line, and of its phases where it reports any."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": str(threads)}
        environment |= {"PYTHONDONTWRITEBYTECODE": ""}  # else whatever changed since the installation is compiled by every process
        environment |= {"NUMBA_CACHE_DIR": folder} if cold else {}
        output = ["--output", str(Path(folder, "adapted"))] if options[0] == "adapt" else []
        command = [sys.executable, "-m", "mipmap_plugin", *options, *output]
        began = time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment, cwd=folder) as process:
            assert process.stdout is not None
            first, first_line = process.stdout.readline(), time.perf_counter() - began
            rest = process.stdout.read()
        seconds = time.perf_counter() - began
    if process.returncode:
        raise RuntimeError(f"{' '.join(options)} ended with exit code {process.returncode}; run it by hand to see why")
    report = json.loads(first + rest)[0] if options[0] == "adapt" else {}
    return {"seconds": seconds, "first_line": first_line, "phases": report.get("seconds", {}), "validation": report.get("validation", {})}


def line(row: dict[str, Any]) -> str:
    phases = (f"{row['phases'][name]:.1f}" if name in row["phases"] else "" for name in PHASES)
    first_line = "" if row["phases"] else f"{row['first_line']:.1f}"  # JSON is printed at the end
    return f"| {row['command']} | {row['version']} | {row['threads']} | {row['seconds']:.1f} | {first_line} | {' | '.join(phases)} |"


if __name__ == "__main__":
    tyro.cli(main)
