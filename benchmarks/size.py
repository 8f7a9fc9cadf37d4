"""Scenes of real size: what each command and each of its phases takes at 0.3, 1 and 3 million splats, beside another version of the project.

    python benchmarks/size.py DATA
    python benchmarks/size.py DATA --splats 3000000 --steps 12 --before ../checkout-of-the-version-before

DATA holds `checkpoints/flowers_r8`. Its splats are split with their moments kept (`workloads.split_into`), until there are as many as wanted, and
rendered at 1256 x 828 px by its 173 cameras. Each command is a process of its own (`size_piece.py`). Prints Markdown; writes size.json and size.md.
"""

from __future__ import annotations

import fcntl
import json
import os
import pty
import shutil
import struct
import subprocess
import sys
import tempfile
import termios
import time
from pathlib import Path
from typing import Any

import torch
import tyro
from rows import joined
from workloads import split_into

from mipmap_plugin.camera import OPENGL_TO_OPENCV
from mipmap_plugin.formats.atomic import write_json
from mipmap_plugin.formats.images import write_image
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import wrap_model

HERE = Path(__file__).parents[1]
SIZES = (300_000, 1_000_000, 3_000_000)
COMMANDS = ("load", "inspect", "adapt", "evaluate")

# `-r 4` of flowers' photographs: 1256 x 828 px.
CFG_ARGS = (
    "Namespace(data_device='cuda', eval=False, images='images', model_path='', resolution=4, sh_degree=3, source_path='', white_background=False)"
)

INTRO = """# Scenes of real size

Made by `python benchmarks/size.py DATA`, in pieces: seconds, CPU seconds and the peak of memory (over what Python, torch and the package
themselves take, as a multiple of the PLY's size) of whole commands and of their phases, `adapt` at x1/4, on flowers with its splats split into so
many, 173 cameras of 1256 x 828 px. *Silence*: the longest time without a sign on the terminal, and in brackets until the first. Two cores, which
nobody else used. `evaluate`: the base and everything that needs no adapting, on {photographs} photographs. {machine}
"""
HEAD = "| splats | command | version | phase | seconds | CPU s | peak / file | silence |\n|" + "---|" * 8


def main(
    data: tyro.conf.Positional[Path],
    before: Path | None = None,
    splats: tyro.conf.UseAppendAction[tuple[int, ...]] = (),
    command: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    steps: int | None = None,
    photographs: int = 4,
    threads: int = 2,
    label: str = "now",
    output: Path = HERE / "benchmarks" / "results",
) -> None:
    """Measure, and add the rows to the tables; rows of the same size, command and version are replaced.

    Args:
        data: The folder with checkpoints/.
        before: A checkout of another version, to be measured beside this one.
        splats: Sizes of the stand-ins; 300,000, 1,000,000 and 3,000,000 by default.
        command: load, inspect, adapt or evaluate; all by default.
        steps: Of `adapt`, where all of them would take too long; the table says how many.
        photographs: Of `evaluate`.
        threads: Of each process.
        label: What this version is called in the tables.
        output: Where the results go.
    """
    versions = {label: HERE} | ({"before": before.resolve()} if before else {})
    rows: list[dict[str, Any]] = []
    for count in splats or SIZES:
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            scene = stand_in(data, count, place / "flowers")
            if "evaluate" in (command or COMMANDS):
                photograph(scene, photographs, place / "images")
            for name in command or COMMANDS:
                for version, checkout in versions.items():
                    facts = measured(checkout, words(name, scene, place, steps), threads, place)
                    size = next(scene.rglob("*.ply")).stat().st_size
                    told = name if name != "adapt" or steps is None else f"adapt, {steps} steps"
                    rows.append({"splats": count, "command": told, "version": version, "file": size, **facts})
                    print("\n".join(lines(rows[-1])), flush=True)
                    keep(rows, output, photographs, threads)


def stand_in(data: Path, count: int, folder: Path) -> Path:
    """A model folder of flowers whose splats are split into `count`."""
    flowers = data / "checkpoints" / "flowers_r8"
    wrapped = wrap_model(flowers)
    model = VanillaModel.from_gaussians(split_into(wrapped.model.gaussians(wrapped.any_camera()).detach(), count))
    model.save(folder / "point_cloud" / "iteration_30000" / "point_cloud.ply", provenance={})
    shutil.copy(flowers / "cameras.json", folder)
    (folder / "cfg_args").write_text(CFG_ARGS)
    return folder


@torch.no_grad()
def photograph(scene: Path, count: int, folder: Path) -> None:
    """A folder of so many photographs of the scene, which are its own images, with the file that says where they were taken."""
    wrapped = wrap_model(scene)
    frames = []
    folder.mkdir()
    for number, view in enumerate(wrapped.cameras[:: len(wrapped.cameras) // count][:count]):
        write_image(folder / f"{number}.png", wrapped.render(view).image)
        pose = torch.linalg.inv(view.viewmat) @ OPENGL_TO_OPENCV
        frames.append({"file_path": f"{number}.png", "transform_matrix": pose.tolist()})
    lens = {"w": view.width, "h": view.height, "fl_x": view.fx, "fl_y": view.fy, "cx": view.cx, "cy": view.cy}
    (folder / "transforms_test.json").write_text(json.dumps({**lens, "frames": frames}))


def words(command: str, scene: Path, place: Path, steps: int | None) -> list[str]:
    """The command with its options."""
    if command == "adapt":
        target = place / "adapted"
        shutil.rmtree(target, ignore_errors=True)
        return ["adapt", str(scene), "--scale", "1/4", "--output", str(target), *([] if steps is None else ["--steps", str(steps)])]
    if command == "evaluate":
        return ["evaluate", str(scene), "--images", str(place / "images"), "--scale", "1/4", "--no-report"]
    return [command, str(scene)]


def measured(checkout: Path, command: list[str], threads: int, place: Path) -> dict[str, Any]:
    """What a command takes in a process of its own, whose standard error is a terminal."""
    facts = place / "facts.json"
    counts = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), str(threads))
    environment = {**os.environ, **counts, "PYTHONPATH": str(checkout)}
    reader, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 120, 0, 0))
    began = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("size_piece.py")), str(facts), *command], stdout=subprocess.DEVNULL, stderr=terminal,
        env=environment, cwd=place,
    )  # fmt: skip
    os.close(terminal)
    signs, said = heard(reader, began)
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - began
    if status:
        sys.exit(f"{' '.join(command)} failed with exit status {status}:\n{said[-2000:].decode(errors='replace')}")
    pauses = [after - sign for sign, after in zip([0.0, *signs], [*signs, seconds], strict=True)]
    told = json.loads(facts.read_text())
    first = max(0.0, pauses[0] - (told.pop("began") - began))  # imports, which a command does behind its first bar, are done before it here
    own = {"seconds": seconds, "cpu": usage.ru_utime + usage.ru_stime, "first sign": first, "silence": max([first, *pauses[1:]])}
    return own | told


def heard(reader: int, began: float) -> tuple[list[float], bytes]:
    """When something was said on the terminal, in seconds, and what."""
    signs, said = [], b""
    while True:
        try:
            piece = os.read(reader, 65536)
        except OSError:  # on Linux, that nobody writes any more
            piece = b""
        if not piece:
            os.close(reader)
            return signs, said
        signs.append(time.perf_counter() - began)
        said += piece


def lines(row: dict[str, Any]) -> list[str]:
    """The rows of the table of one command: the whole, then its phases."""
    head = f"| {row['splats']:,} | {row['command']} | {row['version']} |"
    silence = "" if row["command"] == "load" or row["silence"] is None else f"{row['silence']:.1f} ({row['first sign']:.1f})"
    whole = f"{head} whole | {row['seconds']:.1f} | {row['cpu']:.1f} | {row['peak'] / row['file']:.2f} | {silence} |"
    phases = row["phases"].items() if len(row["phases"]) > 1 else ()
    return [whole, *(f"{head} {name} | {each['seconds']:.1f} | {each['cpu']:.1f} | {each['peak'] / row['file']:.2f} | |" for name, each in phases)]


def keep(rows: list[dict[str, Any]], output: Path, photographs: int, threads: int) -> None:
    """Write the tables: these rows, and those of earlier runs that they do not replace."""
    file = output / "size.json"
    everything = joined(file, dict, rows, lambda row: (row["splats"], row["command"], row["version"]))
    order = lambda row: (row["splats"], COMMANDS.index(row["command"].split(",")[0]), row["command"], row["version"] != "before")  # noqa: E731
    everything.sort(key=order)
    write_json(file, everything, overwrite=True)
    intro = INTRO.format(photographs=photographs, machine=f"{threads} threads.")
    (output / "size.md").write_text("\n".join([intro, HEAD, *(line for row in everything for line in lines(row)), ""]))


if __name__ == "__main__":
    tyro.cli(main)
