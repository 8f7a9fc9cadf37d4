"""Real bases adapted on a GPU to their knee, evaluated on real test images as on the processor (protocol P3)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from real_bases import SCALES

from mipmap_plugin import load_model, load_scene, wrap_model
from mipmap_plugin.evaluation.evaluate import Evaluator, adapted_row
from mipmap_plugin.evaluation.measure import adapt_alone
from mipmap_plugin.evaluation.protocols import PROTOCOLS, test_views
from mipmap_plugin.wrap import own_cameras

RESULTS = Path(__file__).parent / "results"


@dataclass(frozen=True)
class Adaptation:
    """One base adapted to one scale by the default recipe."""

    base: str
    scale: float
    backend: str
    seconds: float
    steps: int
    ended_by: str
    peak_mib: float | None  # of tensors on the GPU
    psnr_db: float  # on real test images that nothing was adapted to
    processor_db: float | None  # the same on a processor; None: not measured


def adaptations(data: Path, backends: Sequence[str], device: str = "cuda", **settings) -> list[Adaptation]:
    """Every base of `data` that is there, at each of its scales, by each backend. `settings` override the recipe's."""
    bases = [base for base in SCALES if (data / "checkpoints" / "bases" / base).is_dir()]
    return [row for base in bases for backend in backends for row in _of_base(data, base, backend, device, settings)]


def _of_base(data: Path, base: str, backend: str, device: str, settings: dict) -> list[Adaptation]:
    here = load_model(data / "checkpoints" / "bases" / base)
    wrapped = wrap_model(here.to(device), cameras=own_cameras(here), backend=backend)
    scene = wrapped.place(load_scene(data / "images" / base.split("_")[0]))
    evaluator = Evaluator(test_views(scene, wrapped.cameras, wrapped.background), PROTOCOLS["P3"])
    wrapped.adapt(1 / 2, **{**settings, "steps": 10})  # compiles what is to be compiled
    rows = []
    for scale in SCALES[base]:
        if scale == 1:
            continue
        adapted = adapt_alone(wrapped, scale, **settings)
        report, psnr_db = adapted.report, adapted_row("", adapted, evaluator).psnr_db
        steps = report.curve[-1].step if report.curve else 0
        took = dict(seconds=report.seconds["total"], steps=steps, ended_by=report.ended_by, peak_mib=report.peak_memory_mib)
        rows.append(Adaptation(base, scale, backend, psnr_db=psnr_db, processor_db=on_processor(base, scale), **took))
    return rows


def on_processor(base: str, scale: float) -> float | None:
    """dB of the same row in the results of `real_bases.py`."""
    file = RESULTS / f"{base}.json"
    rows = json.loads(file.read_text()) if file.exists() else []
    return next((row["psnr_db"] for row in rows if row["name"] == "default, held out" and row["scale"] == scale), None)
