"""Bases adapted on a GPU by the default recipe, for some viewers too: seconds, memory, and dB beside those of a processor."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from bases import judge_of
from gpu_records import Adaptation
from gpu_work import Work, kept
from workloads import split_into

from mipmap_plugin import load_model, wrap_model
from mipmap_plugin.adaptation.optimization.ending import End
from mipmap_plugin.evaluation.evaluate import Evaluator, adapted_row
from mipmap_plugin.evaluation.measure import adapt_alone
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import Wrapped

RESULTS = Path(__file__).parent / "results"
FLOWERS = "flowers_r8"

QUICK_S = 6.0  # an adaptation that takes longer is not done twice

# Seconds before the end at which steps end, for what comes after them.
AFTER_STEPS_S = 10.0

# dB on held-out views of the base's own, by backend cpu, by base, scale and viewer: no table has these rows.
ON_PROCESSOR = {
    (FLOWERS, 1 / 4, ""): 38.44, (FLOWERS, 1 / 2, ""): 43.02, (FLOWERS, 2, ""): 48.46, ("lego_200", 1 / 4, "playcanvas"): 38.28,
    ("lego_200", 1 / 4, "portable"): 26.02, ("lego_100", 2, "playcanvas"): 39.44,
    ("lego_100", 2, "portable"): 32.59,
}  # fmt: skip


@dataclass(frozen=True)
class Base:
    """A base, and the seconds that an adaptation takes, with loading, compiling and judging."""

    name: str
    seconds: float
    splats: int | None = None  # split into so many

    @property
    def title(self) -> str:
        return self.name if self.splats is None else f"{self.name} in {self.splats:,}"

    @property
    def path(self) -> Path:
        """Below the folder of the data."""
        return Path("checkpoints") / (self.name if self.name == FLOWERS else f"bases/{self.name}")


LEGO, CHAIR, CAPTURE, LARGE = Base("lego_200", 15), Base("chair_400", 20), Base(FLOWERS, 30), Base(FLOWERS, 60, 3_000_000)

# The most telling first, for a run whose time ends; those of a base side by side, for it is loaded once.
ROWS = (
    (LEGO, 1 / 4), (LEGO, 1 / 2), (CHAIR, 1 / 4), (CHAIR, 1 / 2), (CAPTURE, 1 / 4), (CAPTURE, 1 / 2), (CAPTURE, 2), (LARGE, 1 / 4),
    (Base("lego_100", 15), 2), (Base("chair_100", 15), 2), (LEGO, 1 / 8), (CHAIR, 1 / 8),
)  # fmt: skip
FOR_VIEWERS = ((LEGO, 1 / 4), (Base("lego_100", 15), 2))
VIEWERS = ("playcanvas", "portable")


@dataclass(frozen=True)
class Place:
    """Where adaptations run, and until when."""

    data: Path
    backend: str
    device: str = "cuda"
    until: float = math.inf  # of `time.monotonic`, when steps end
    settings: tuple[tuple[str, Any], ...] = ()  # that override the recipe's


@dataclass(frozen=True)
class Subject:
    """A base on the device, what judges it, and when adapting it ends."""

    base: Base
    wrapped: Wrapped
    judge: Evaluator | None
    place: Place

    @classmethod
    def of(cls, base: Base, place: Place) -> Subject:
        here = load_model(place.data / base.path)
        cameras = wrap_model(here).cameras
        model = here.to(place.device)
        wrapped = wrap_model(model if base.splats is None else denser(model, base.splats), cameras=cameras, backend=place.backend)
        is_judged = (place.data / "images" / base.name.split("_")[0]).is_dir()
        return cls(base, wrapped, judge_of(wrapped, place.data, base.name) if is_judged else None, place)

    def adapted(self, scale: float, viewer: str = "") -> Adaptation:
        """Adapt it, twice where that is quick."""
        options = dict(self.place.settings) | {"viewer": viewer or None, "observe": self._is_over}
        began = time.perf_counter()
        adapted = adapt_alone(self.wrapped, scale, **options)
        wall_seconds = time.perf_counter() - began
        report = adapted.report
        again = self.wrapped.adapt(scale, **options).report if wall_seconds < QUICK_S else report
        steps = report.curve[-1].step if report.curve else 0
        took = dict(seconds=report.seconds["total"], again_seconds=again.seconds["total"], wall_seconds=wall_seconds, phases=report.seconds)
        ended = dict(steps=steps, ended_by=ENDED.get(report.ended_by, report.ended_by), peak_mib=report.peak_memory_mib)
        judged = self.judge is not None and not viewer
        psnr_db = adapted_row("", adapted, self.judge).psnr_db if judged else report.psnr_after() or float("nan")
        quality = dict(psnr_db=psnr_db, processor_db=on_processor(self.base.title, scale, viewer), viewer=viewer)
        return Adaptation(self.base.title, scale, self.wrapped.backend()[0].name, **took, **ended, **quality)

    def _is_over(self, *_: object) -> bool:
        return time.monotonic() > self.place.until


# What a report says where `_is_over`, and what is meant.
ENDED = {End.OBSERVER.value: "the end of the time"}


def denser(model: SplatModel, splats: int) -> SplatModel:
    """A stand-in for a larger capture: the same scene of more splats."""
    with torch.no_grad():
        return VanillaModel.from_gaussians(split_into(model.gaussians(wrap_model(model).any_camera()), splats), model.trained)


@kept
def subject_of(base: Base, place: Place) -> Subject:
    """The subject, kept for further scales; what its first adaptation compiles is compiled."""
    subject = Subject.of(base, place)
    if base.splats is None:
        subject.wrapped.adapt(1 / 4, **{**dict(place.settings), "steps": 10})
    return subject


def adapt_one(base: Base, scale: float, viewer: str, place: Place) -> Iterator[Adaptation]:
    """A base at one scale, for a viewer or for none ("")."""
    yield subject_of(base, place).adapted(scale, viewer)


def works(place: Place, rows: Sequence[tuple[Base, float]]) -> list[Work]:
    """Every base that is there at each of its scales."""
    return [_work("adaptation", base, scale, "", place) for base, scale in rows if (place.data / base.path).is_dir()]


def works_for_viewers(place: Place, rows: Sequence[tuple[Base, float]]) -> list[Work]:
    """Some bases for a viewer, and for all viewers."""
    return [_work("viewers", base, scale, viewer, place) for base, scale in rows for viewer in VIEWERS if (place.data / base.path).is_dir()]


def _work(part: str, base: Base, scale: float, viewer: str, place: Place) -> Work:
    place = replace(place, until=place.until - AFTER_STEPS_S)
    what = " ".join(filter(None, [base.title, f"x{scale:g}", viewer and f"for {viewer}"]))
    return Work(part, place.backend, what, base.seconds, adapt_one, (base, scale, viewer, place))


def on_processor(base: str, scale: float, viewer: str = "") -> float | None:
    """dB of the same row, for none of the viewers in the results of `real_bases.py`."""
    file = RESULTS / f"{base}.json"
    rows = json.loads(file.read_text()) if file.exists() and not viewer else []
    found = next((row["psnr_db"] for row in rows if row["name"] == "default, held out" and row["scale"] == scale), None)
    return ON_PROCESSOR.get((base, scale, viewer)) if found is None else found
