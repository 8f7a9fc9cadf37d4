"""One scene adapted untiled and in tiles: seams, quality, peak memory of a process, and CPU time.

    python benchmarks/tiles.py SCENE --scale 1/4 --tiles 8
    python benchmarks/tiles.py SCENE --cameras FILE --tiles 4 --steps 300

Untiled with two seeds, and in tiles, each in a process of its own. Seams: PSNR between the tiled and the untiled result over held-out views; beside
it stands that between the two seeds, below which no difference is a seam. Quality: dB against the base, supersampled. Memory is the
peak of one process (of tiles: of the largest of its workers), with what Python and torch take, CPU time that of all processes. Adds the row
of the scene to results/tiles.json, and writes results/tiles.md from all rows.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from fractions import Fraction
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
import tyro
from rows import joined

from mipmap_plugin import load_scene, wrap_model
from mipmap_plugin.adaptation.adapted import render_model
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.atomic import write_json
from mipmap_plugin.models import load_model
from mipmap_plugin.scenes import jittered
from mipmap_plugin.wrap import Wrapped

RESULTS = Path(__file__).parent / "results"

# Views that neither run was adapted to, and the seed that they follow from.
JUDGED, SEED = 8, 104_729

RUNS = {"untiled": [], "other seed": ["--seed", "1"], "tiled": ["--jobs", "1"]}


def measured(command: list[str]) -> dict[str, float]:
    """Run the command line in a process of its own; return its seconds, CPU seconds with all it started, and the peak of its largest process."""
    code = (
        "import json, resource as r, sys; from mipmap_plugin.cli import main; code = main(sys.argv[1:]);"
        "own, others = r.getrusage(r.RUSAGE_SELF), r.getrusage(r.RUSAGE_CHILDREN);"
        "cpu = own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime;"
        "print(json.dumps({'cpu': cpu, 'own_mib': own.ru_maxrss / 1024, 'job_mib': max(own.ru_maxrss, others.ru_maxrss) / 1024}), file=sys.stderr);"
        "sys.exit(code)"
    )
    began = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code, *command], capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(done.stderr)
    facts: dict[str, float] = json.loads(done.stderr.strip().splitlines()[-1])
    return {"seconds": time.perf_counter() - began, **facts}


def held_out(base: Wrapped) -> list[Camera]:
    """Views around those of the base, which no seed of adapting draws."""
    return jittered(evenly(base.views(), 40), JUDGED, torch.Generator().manual_seed(SEED))


def compared(base: Wrapped, files: dict[str, Path], scale: float) -> dict[str, float]:
    """PSNR (dB) of each file against the supersampled base, and of each against the untiled one, as means over views."""
    fine = round(1 / scale)
    models = {name: load_model(path) for name, path in files.items()}
    backend, _ = base.backend()
    target = base.targets(None)[""]
    rows: dict[str, list[float]] = {}
    for view in held_out(base):
        camera = view.zoomed(scale)
        truth = base.render(camera, scale, "scaled", supersampling=fine).image.clamp(0, 1)
        images = {name: render_model(model, backend, camera, target).image.clamp(0, 1) for name, model in models.items()}
        for name, image in images.items():
            rows.setdefault(f"{name} against supersampled", []).append(psnr(image, truth))
            if name != "untiled":
                rows.setdefault(f"{name} against untiled", []).append(psnr(image, images["untiled"]))
    return {name: fmean(values) for name, values in rows.items()}


def run(
    scene: tyro.conf.Positional[Path], scale: str = "1/4", tiles: int = 8, cameras: Path | None = None, steps: int | None = None, name: str = ""
) -> None:
    """Measure a scene, and write the page."""
    further = ["--backend", "cpu", *(["--cameras", str(cameras)] if cameras else []), *(["--steps", str(steps)] if steps is not None else [])]
    row: dict[str, Any] = {"scene": name or scene.stem, "scale": scale, "tiles": tiles, "steps": steps}
    with tempfile.TemporaryDirectory() as folder:
        files = {each: Path(folder) / f"{each.replace(' ', '_')}.ply" for each in RUNS}
        for each, options in RUNS.items():
            own = ["--tiles", str(tiles), *options] if each == "tiled" else options
            row[each] = measured(["adapt", str(scene), "--scale", scale, "--output", str(files[each]), *own, *further])
        base = wrap_model(scene, cameras=None if cameras is None else load_scene(cameras), backend="cpu")
        row["splats"] = len(base.model.parameters()["means"])
        row |= compared(base, files, float(Fraction(scale)))
    rows = joined(RESULTS / "tiles.json", dict, [row], lambda each: (each["scene"], each["tiles"], each["steps"]))
    write_json(RESULTS / "tiles.json", rows, overwrite=True)
    (RESULTS / "tiles.md").write_text(page(rows), encoding="utf-8")


COLUMNS = ("scene", "splats", "tiles", "tiled = untiled, dB", "two seeds, dB", "untiled, dB", "tiled, dB", "peak MiB", "CPU s")


def page(rows: list[dict[str, Any]]) -> str:
    """The table of all rows."""
    lines = [
        "# One scene in tiles", "", "`python benchmarks/tiles.py SCENE`", "",
        "*tiled = untiled*: PSNR between both results on held-out views; *two seeds*: between two untiled results. *untiled*, *tiled*: PSNR",
        "against the supersampled base. Peak memory of a process and CPU time: untiled, then tiled.", "",
        f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS),
    ]  # fmt: skip
    for row in rows:
        untiled, tiled = row["untiled"], row["tiled"]
        steps = "" if row["steps"] is None else f", {row['steps']} steps"
        cells = [
            f"{row['scene']} x{row['scale']}{steps}", f"{row['splats']:,}", row["tiles"], f"{row['tiled against untiled']:.1f}",
            f"{row['other seed against untiled']:.1f}", f"{row['untiled against supersampled']:.2f}", f"{row['tiled against supersampled']:.2f}",
            f"{untiled['job_mib']:.0f}, {tiled['job_mib']:.0f} ({tiled['job_mib'] / untiled['job_mib']:.2f}x)",
            f"{untiled['cpu']:.0f}, {tiled['cpu']:.0f} ({tiled['cpu'] / untiled['cpu']:.2f}x)",
        ]  # fmt: skip
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    tyro.cli(run)
