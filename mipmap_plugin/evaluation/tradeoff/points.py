"""Accuracy against time: one scene at one scale with several recipes, steps, backends and renderer settings, and all baselines without
adaptation. The time to measure quality is not counted, and evaluated views are never adapted to."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.backends import get_backend
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation.cells import Cells
from mipmap_plugin.evaluation.measure import (
    BASE,
    FILTERS,
    RESIZED,
    Baseline,
    Kind,
    RenderView,
    adapt_alone,
    base_in_viewer,
    baselines,
    warm_stopwatch,
    warm_up,
)  # fmt: skip
from mipmap_plugin.evaluation.tradeoff.truth import GroundTruth
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.progress import ticking
from mipmap_plugin.recipes import most_steps
from mipmap_plugin.screen_filters import SCREEN_FILTERS
from mipmap_plugin.wrap import Wrapped

# Steps after which the quality of a run is measured: evenly spaced on the logarithmic axis of time.
OBSERVED_STEPS = (0, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)

# Renderer settings that may save time, each alone: (name, what is changed, float type).
RENDERERS: tuple[tuple[str, dict[str, Any], torch.dtype], ...] = (
    ("as usual", {}, torch.float32),
    ("float64", {}, torch.float64),
    *((f"alpha from {name}", {"min_alpha": 1 / least}, torch.float32) for name, least in (("1/64", 64), ("1/16", 16))),
    *((f"stop at {least:g}", {"min_transmittance": least}, torch.float32) for least in (0.01, 0.1)),
    *((f"radius {radius:g}", {"radius": radius}, torch.float32) for radius in (3.0, 2.0)),
    *((f"tile {tile}", {"tile": tile}, torch.float32) for tile in (8, 32)),
)  # fmt: skip


@dataclass(frozen=True)
class Spread:
    """Several measurements of one thing."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """The median and the range of several values."""
        return cls(statistics.median(values), min(values), max(values))


NOTHING = Spread(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Point:
    """One way to render a scene at one scale: its cost and its quality."""

    scale: float
    kind: Kind
    name: str
    backend: str
    gaussians: int
    psnr_db: Spread = NOTHING
    adapt_seconds: Spread = NOTHING
    ms_per_frame: Spread | None = None  # None: an intermediate point of a run
    step: int | None = None  # of an intermediate point
    ended_by: str = ""  # of a final point: why the run ended, with all reasons if repeats differ


@dataclass(frozen=True)
class Plan:
    """What to measure."""

    recipes: Sequence[str] = ("default",)
    steps: Sequence[int | None] = ()  # none: those of each recipe
    backends: Sequence[str] = ("auto",)
    supersampling: Sequence[int] = (2, 4, 8)
    renderers: bool = True  # also measure the first run's model with the settings of RENDERERS
    repeats: int = 3
    seed: int = 0  # of the first repeat; further repeats have the following seeds
    viewer: str | None = None  # what files are adapted for, and the base is also rendered as

    def __post_init__(self) -> None:
        if self.repeats < 1 or any(n < 2 for n in self.supersampling):
            raise SettingsError("repeats must be at least 1, and supersampling at least 2")


def measure(model: Wrapped, truth: GroundTruth, scale: float, plan: Plan, cells: Cells | None = None) -> Iterator[Point]:
    """Yield each point as soon as it is measured, or found in `cells`. Raises SettingsError and BackendUnavailable."""
    cells = cells or Cells()
    asked = product(plan.backends, plan.recipes, plan.steps or (None,))
    runs = list(dict.fromkeys((name, most_steps(name, scale, steps), backend) for backend, name, steps in asked))
    free = [baseline for backend in plan.backends for baseline in _baselines(on_backend(model, backend), truth, scale, plan)]
    count = len(model.model.gaussians(model.any_camera()))
    bar = tqdm(total=len(free) + len(runs) * plan.repeats + len(RENDERERS) * plan.renderers, disable=None, desc=f"tradeoff x{scale:g}")
    first: list[Adapted] = []  # of the first of the runs
    warm: set[str] = set()

    def kept(key: dict[str, Any], measure: Callable[[], list[Point]]) -> list[Point]:
        return _kept(cells, {"scale": scale, "truth": truth.label, "repeats": plan.repeats, "seed": plan.seed, "viewer": plan.viewer} | key, measure)

    def shown(baseline: Baseline) -> list[Point]:
        return [_measured(Point(scale, baseline.kind, baseline.name, baseline.backend, count), baseline.render, truth, plan.repeats)]

    def run(name: str, steps: int | None, backend: str) -> list[Point]:
        if backend not in warm:
            warm_up(on_backend(model, backend), scale, truth.adapt_on)
            warm.add(backend)
        points, adapted = _run(on_backend(model, backend), truth, scale, plan, (name, steps), bar)
        if (name, steps, backend) == runs[0]:
            first.append(adapted)
        return points

    def rendered() -> list[Point]:
        if runs and not first:  # it was measured before an interruption
            run(*runs[0])
        shown = _renderers(model, first[0] if runs else None, scale)
        return [_measured(point, show, truth, plan.repeats) for point, show in shown]

    with bar, ticking(bar):
        for baseline in free:
            yield from kept({"baseline": baseline.name, "backend": baseline.backend}, partial(shown, baseline))
            bar.update()
        for name, steps, backend in runs:
            yield from kept({"recipe": name, "steps": steps, "backend": backend}, partial(run, name, steps, backend))
        if plan.renderers:
            yield from kept({"renderers": runs[:1]}, rendered)
            bar.update(len(RENDERERS))


def _kept(cells: Cells, key: dict[str, Any], measure: Callable[[], list[Point]]) -> list[Point]:
    """The points of a cell: measured now, or kept from before an interruption."""
    known = cells.find(key)
    if known is None:
        points = measure()
        cells.keep(key, {"points": [asdict(point) for point in points]})
        return points
    return [_point(facts) for facts in known["points"]]


def _point(facts: dict[str, Any]) -> Point:
    """The point that `asdict` made these facts of."""
    values: dict[str, Any] = {name: Spread(**value) if isinstance(value, dict) else value for name, value in facts.items()}
    return Point(**values)


def on_backend(model: Wrapped, name: str) -> Wrapped:
    """The same base, rendered and adapted by another backend."""
    return Wrapped(model.model, model.cameras, name, model.trained, model.threads)


def _baselines(model: Wrapped, truth: GroundTruth, scale: float, plan: Plan) -> list[Baseline]:
    """All baselines, except the one that is the truth itself."""
    found = baselines(model, scale, truth.shrink_by, filters=_filters(model), samples=plan.supersampling)
    found += [base_in_viewer(plan.viewer, model, scale)] if plan.viewer else []
    return [baseline for baseline in found if not (truth.is_resized_base and baseline.name == RESIZED)]


def _filters(model: Wrapped) -> list[str]:
    """All screen filters except that of the model's training; those of the other tables come first."""
    return [name for name in (*FILTERS, *sorted(SCREEN_FILTERS.keys() - set(FILTERS))) if name != model.trained.screen_filter]


def left_out(model: Wrapped, plan: Plan) -> list[str]:
    """The filters that backends of the plan lack, in sentences."""
    wrapped = [on_backend(model, name) for name in plan.backends]
    return [f"there is no {name} filter, since {reason}" for each in wrapped for name in _filters(each) if (reason := each.lacks(name))]


def _measured(point: Point, show: RenderView, truth: GroundTruth, repeats: int) -> Point:
    """Measure the PSNR and the milliseconds per frame of a point: the means over the views in each repeat."""
    times, psnrs = [], []
    with torch.no_grad():
        watch = warm_stopwatch(show, truth.views[0])
        for repeat in range(repeats):
            watch.seconds = 0.0
            for view in truth.views:
                with watch:
                    image = show(view)
                if repeat == 0:
                    psnrs.append(truth.psnr(view, image))
            times.append(1000 * watch.seconds / len(truth.views))
    return replace(point, psnr_db=Spread.of([statistics.fmean(psnrs)]), ms_per_frame=Spread.of(times))


def _run(
    model: Wrapped, truth: GroundTruth, scale: float, plan: Plan, run: tuple[str, int | None], bar: tqdm
) -> tuple[list[Point], Adapted]:
    """Run a recipe (with a number of steps) in all repeats; return its intermediate and final points, and the model of the first repeat."""
    recipe, steps = run
    measured: dict[int, list[tuple[float, float]]] = {}  # by step: seconds and dB of each repeat that took as many steps

    @torch.no_grad()
    def observe(step: int, seconds: float, show: RenderView) -> None:
        if step in OBSERVED_STEPS:
            quality = statistics.fmean(truth.psnr(view, show(view.zoomed(scale))) for view in truth.views)
            measured.setdefault(step, []).append((seconds, quality))

    first: Adapted | None = None
    ends = []
    for repeat in range(plan.repeats):
        settings: dict[str, Any] = {"seed": plan.seed + repeat} | ({} if steps is None else {"steps": steps})
        adapted = adapt_alone(model, scale, recipe=recipe, viewer=plan.viewer, cameras=truth.adapt_on or None, observe=observe, **settings)
        first, report = first or adapted, adapted.report
        end = Point(scale, "adapted", _name(recipe, steps), adapted.backend.name, report.gaussians_after, ended_by=report.ended_by)
        ends.append(_measured(replace(end, adapt_seconds=Spread.of([report.seconds["total"]])), _shows(adapted, scale), truth, 1))
        bar.update()
    assert first is not None  # since there is at least one repeat
    intermediate, curve = replace(ends[0], ms_per_frame=None, ended_by=""), first.report.curve

    def between(step: int, values: Sequence[tuple[float, float]]) -> Point:
        splats = next((point.gaussians for point in reversed(curve) if point.step <= step), intermediate.gaussians)
        seconds, qualities = zip(*values, strict=True)
        return replace(intermediate, step=step, gaussians=splats, **_spreads(adapt_seconds=seconds, psnr_db=qualities))

    return [*(between(step, values) for step, values in measured.items()), _over_repeats(ends)], first


def _name(recipe: str, steps: int | None) -> str:
    return recipe if steps is None else f"{recipe}, {steps} steps at most"


def _spreads(**values: Sequence[float]) -> dict[str, Any]:
    return {name: Spread.of(repeats) for name, repeats in values.items()}


def _over_repeats(ends: Sequence[Point]) -> Point:
    """The final points of all repeats as one point."""
    measured = {name: [getattr(end, name).median for end in ends] for name in ("psnr_db", "adapt_seconds", "ms_per_frame")}
    return replace(ends[0], ended_by="; ".join(dict.fromkeys(end.ended_by for end in ends)), **_spreads(**measured))


def _shows(adapted: Adapted, scale: float) -> RenderView:
    return lambda view: adapted.render(view.zoomed(scale)).image


def _renderers(model: Wrapped, adapted: Adapted | None, scale: float) -> Iterator[tuple[Point, RenderView]]:
    """The adapted model, or else the base, rendered by the reference backend with each of RENDERERS."""
    backend = get_backend("reference")
    splats: SplatModel = adapted.model if adapted else model.model
    effects = adapted.effects if adapted else model.effects(scale)
    title = adapted.report.settings.recipe if adapted else BASE
    seconds = Spread.of([adapted.report.seconds["total"]]) if adapted else NOTHING
    count = len(splats.gaussians(model.any_camera()))
    for name, changes, dtype in RENDERERS:
        settings = replace(effects.settings, **changes)
        point = Point(scale, "renderer", f"{title}, {name}", backend.name, count, adapt_seconds=seconds)
        yield point, _render_with(backend, splats, replace(effects, settings=settings), dtype, scale)


def _render_with(backend: Backend, model: SplatModel, effects: Effects, dtype: torch.dtype, scale: float) -> RenderView:
    def show(view: Camera) -> Tensor:
        camera = view.zoomed(scale)
        return backend.render(model.gaussians(camera).to(dtype=dtype), camera, effects).image

    return show
