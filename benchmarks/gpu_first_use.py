"""What somebody waits for who adapts on a machine for the first time, when every kernel is compiled, and for the second time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from gpu_records import FirstUse
from gpu_work import Work

from mipmap_plugin.models.places import REPORT

BASE, STEPS, EXPECTED_S = "lego_200", 10, 60.0
COMMAND = "from mipmap_plugin.cli import main; raise SystemExit(main())"


def measure(backend: str, viewer: str, data: Path) -> Iterator[FirstUse]:
    """The command twice, with an empty folder for what Triton keeps."""
    with TemporaryDirectory() as folder:
        (first, compiling), (again, compiling_again) = (_run(backend, viewer, data, Path(folder), name) for name in ("first", "again"))
    yield FirstUse(backend, viewer, first, compiling, again, compiling_again)


def _run(backend: str, viewer: str, data: Path, folder: Path, name: str) -> tuple[float, float]:
    """The seconds of the command, and those that its report gives for compilation."""
    output = folder / f"{name}.ply"
    words = ["adapt", data / "checkpoints" / "bases" / BASE, "--scale", "1/4", "--steps", STEPS, "--backend", backend, "--output", output]
    words += ["--viewer", viewer] if viewer else []
    began = time.monotonic()
    kept = {"TRITON_CACHE_DIR": str(folder / "triton")}
    done = subprocess.run([sys.executable, "-c", COMMAND, *map(str, words)], check=False, capture_output=True, text=True, env={**os.environ, **kept})
    seconds = time.monotonic() - began
    if done.returncode:
        raise RuntimeError((done.stderr.strip().splitlines() or ["it failed without a word"])[-1])
    report = json.loads((folder / f"{name}.ply{REPORT}").read_text())
    return round(seconds, 2), round(report["seconds"]["compilation"], 2)


def works(backend: str, data: Path) -> list[Work]:
    """With the usual settings, and for a viewer."""
    there = (data / "checkpoints" / "bases" / BASE).is_dir()
    return [_work(backend, viewer, data) for viewer in ("", "playcanvas")] if there else []


def _work(backend: str, viewer: str, data: Path) -> Work:
    return Work("adaptation", backend, " ".join(filter(None, ["first use", viewer])), EXPECTED_S, measure, (backend, viewer, data))
