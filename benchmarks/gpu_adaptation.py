"""Bases adapted on a GPU by the default recipe: seconds, memory, and dB beside those of a processor."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from workloads import split_into

from mipmap_plugin import load_model, load_scene, wrap_model
from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.evaluation.evaluate import Evaluator, adapted_row
from mipmap_plugin.evaluation.measure import adapt_alone
from mipmap_plugin.evaluation.protocols import PROTOCOLS, test_views
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import Wrapped, own_cameras

RESULTS = Path(__file__).parent / "results"
FLOWERS = "flowers_r8"

QUICK_S = 6.0  # an adaptation that takes longer is not done twice

# dB on held-out views of the base's own, by backend cpu: no table has these rows.
ON_PROCESSOR = {(FLOWERS, 1 / 4): 38.44, (FLOWERS, 2): 48.46}


@dataclass(frozen=True)
class Base:
    """A base, and what it is adapted to."""

    name: str
    scales: tuple[float, ...]
    splats: int | None = None  # split into so many

    @property
    def title(self) -> str:
        return self.name if self.splats is None else f"{self.name} in {self.splats:,}"

    @property
    def path(self) -> Path:
        """Below the folder of the data."""
        return Path("checkpoints") / (self.name if self.name == FLOWERS else f"bases/{self.name}")


# The most telling first, for a run whose time ends.
BASES = (
    Base("lego_200", (1 / 4, 1 / 2, 1 / 8)), Base("lego_100", (2, 4)), Base("chair_400", (1 / 4, 1 / 2, 1 / 8)), Base(FLOWERS, (1 / 4, 2)),
    Base(FLOWERS, (1 / 4,), 3_000_000), Base("chair_100", (2, 4)),
)  # fmt: skip


@dataclass(frozen=True)
class Adaptation:
    """One base adapted to one scale by the default recipe."""

    base: str
    scale: float
    backend: str
    seconds: float  # as the report counts: without loading
    again_seconds: float  # of a second adaptation to the same scale
    wall_seconds: float  # of the first, all in all
    steps: int
    ended_by: str
    peak_mib: float | None  # of tensors on the GPU
    psnr_db: float  # on real test images that nothing was adapted to, or on held-out views of the base's own
    processor_db: float | None  # the same on a processor; None: not measured
    phases: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Subject:
    """A base on the device, what judges it, and settings that override the recipe's."""

    base: Base
    wrapped: Wrapped
    judge: Evaluator | None
    settings: dict[str, Any]

    @classmethod
    def of(cls, base: Base, data: Path, backend: str, device: str, settings: dict[str, Any]) -> Subject:
        here = load_model(data / base.path)
        cameras = own_cameras(here)
        model = here.to(device)
        wrapped = wrap_model(model if base.splats is None else denser(model, base.splats), cameras=cameras, backend=backend)
        images = data / "images" / base.name.split("_")[0]
        judge = None
        if images.is_dir():
            judge = Evaluator(test_views(wrapped.place(load_scene(images)), wrapped.cameras, wrapped.background), PROTOCOLS["P3"])
        return cls(base, wrapped, judge, settings)

    def adapted(self, scale: float) -> Adaptation:
        """Adapt it, twice where that is quick."""
        began = time.perf_counter()
        adapted = adapt_alone(self.wrapped, scale, **self.settings)
        wall_seconds = time.perf_counter() - began
        report = adapted.report
        again = self.wrapped.adapt(scale, **self.settings).report if wall_seconds < QUICK_S else report
        steps = report.curve[-1].step if report.curve else 0
        took = dict(seconds=report.seconds["total"], again_seconds=again.seconds["total"], wall_seconds=wall_seconds, phases=report.seconds)
        ended = dict(steps=steps, ended_by=report.ended_by, peak_mib=report.peak_memory_mib)
        quality = dict(psnr_db=self._psnr_db(adapted), processor_db=on_processor(self.base.title, scale))
        return Adaptation(self.base.title, scale, self.wrapped.backend()[0].name, **took, **ended, **quality)

    def _psnr_db(self, adapted: Adapted) -> float:
        return adapted_row("", adapted, self.judge).psnr_db if self.judge else adapted.report.psnr_after() or float("nan")


def denser(model: SplatModel, splats: int) -> SplatModel:
    """A stand-in for a larger capture: the same scene of more splats."""
    with torch.no_grad():
        return VanillaModel.from_gaussians(split_into(model.gaussians(own_cameras(model)[0]), splats), model.trained)


def of_base(base: Base, data: Path, backend: str, device: str = "cuda", **settings: Any) -> Iterator[Adaptation]:
    """A base at each of its scales. `settings` override the recipe's."""
    subject = Subject.of(base, data, backend, device, settings)
    if base.splats is None:
        subject.wrapped.adapt(base.scales[0], **{**settings, "steps": 10})  # compiles what is to be compiled
    for scale in base.scales:
        yield subject.adapted(scale)


def on_processor(base: str, scale: float) -> float | None:
    """dB of the same row in the results of `real_bases.py`."""
    file = RESULTS / f"{base}.json"
    rows = json.loads(file.read_text()) if file.exists() else []
    found = next((row["psnr_db"] for row in rows if row["name"] == "default, held out" and row["scale"] == scale), None)
    return ON_PROCESSOR.get((base, scale)) if found is None else found
