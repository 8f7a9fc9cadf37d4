"""Accuracy against time: one scene at one scale with several recipes, steps, backends and renderer settings, and all baselines without
adaptation. The time to measure quality is not counted, and evaluated views are never adapted to."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.backends import get_backend
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import plural
from mipmap_plugin.evaluation.cells import Cells, made_by
from mipmap_plugin.evaluation.measure import BASE, FILTERS, Baseline, RenderView, adapt_alone, base_in_viewer, baselines, warm_stopwatch, warm_up
from mipmap_plugin.evaluation.tradeoff.points import NOTHING, Plan, Point, Spread
from mipmap_plugin.evaluation.tradeoff.truth import GroundTruth
from mipmap_plugin.models.base import SplatModel, count_of
from mipmap_plugin.process import threads
from mipmap_plugin.progress import Bar, ticking
from mipmap_plugin.recipes import most_steps
from mipmap_plugin.recipes import recipe as make_config
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


def measure(model: Wrapped, truth: GroundTruth, scale: float, plan: Plan, cells: Cells | None = None) -> Iterator[Point]:
    """Yield each point as soon as it is measured, or found in `cells`. Raises SettingsError and BackendUnavailable."""
    return _Measurement(model, truth, scale, plan, cells or Cells()).points()


class _Measurement:
    """The measurement of all points of one scale."""

    def __init__(self, model: Wrapped, truth: GroundTruth, scale: float, plan: Plan, cells: Cells) -> None:
        self._model, self._truth, self._scale, self._plan, self._cells = model, truth, scale, plan, cells
        asked = product(plan.backends, plan.recipes, plan.steps or (None,))
        self._runs = list(dict.fromkeys((name, most_steps(name, scale, steps), backend) for backend, name, steps in asked))
        self._first: Adapted | None = None  # of the first of the runs
        self._warm: set[str] = set()  # backends

    def points(self) -> Iterator[Point]:
        """Yield each point: of all baselines, of all runs, and of the first run's model in other renderers."""
        plan, scale = self._plan, self._scale
        free = [each for backend in plan.backends for each in _baselines(on_backend(self._model, backend), self._truth, scale, plan)]
        total = len(free) + len(self._runs) * plan.repeats + len(RENDERERS) * plan.renderers
        with Bar(total=total, desc=f"tradeoff x{scale:g}") as bar, ticking(bar):
            for baseline in free:
                yield from self._kept({"baseline": baseline.name, "backend": baseline.backend}, partial(self._of_baseline, baseline))
                bar.update()
            for name, steps, backend in self._runs:
                run = {"recipe": name, "steps": steps, "backend": backend, "made": self._made(name)}
                yield from self._kept(run, partial(self._of_run, name, steps, backend, bar))
            if plan.renderers:
                made = [self._made(name) for name, *_ in self._runs[:1]]
                yield from self._kept({"renderers": self._runs[:1], "made": made}, partial(self._of_renderers, bar))
                bar.update(len(RENDERERS))

    def _made(self, recipe: str) -> dict[str, Any]:
        """The settings of a recipe; a registered one may have been edited since an interruption."""
        return made_by(make_config(recipe, self._scale))

    def _kept(self, key: dict[str, Any], measure: Callable[[], list[Point]]) -> list[Point]:
        """The points of a cell: measured now, or kept from before an interruption."""
        plan = self._plan
        key = key | {"scale": self._scale, "truth": self._truth.label, "repeats": plan.repeats, "seed": plan.seed, "viewer": plan.viewer}
        if (known := self._cells.find(key)) is not None:
            return [Point.of(facts) for facts in known["points"]]
        points = measure()
        self._cells.keep(key, {"points": [asdict(point) for point in points]})
        return points

    def _of_baseline(self, baseline: Baseline) -> list[Point]:
        point = Point(self._scale, baseline.kind, baseline.name, baseline.backend, baseline.gaussians)
        return [_measured(point, baseline.render, self._truth, self._plan.repeats)]

    def _of_run(self, recipe: str, steps: int | None, backend: str, bar: Bar) -> list[Point]:
        """The intermediate and final points of a recipe, with a number of steps, over all repeats."""
        model, truth, scale, plan = on_backend(self._model, backend), self._truth, self._scale, self._plan
        if backend not in self._warm:
            warm_up(model, scale, truth.adapt_on)
            self._warm.add(backend)
        cameras = [replace(view, split="train") for view in truth.adapt_on] or None  # however the checkpoint marks them
        measured: dict[int, list[tuple[float, float]]] = {}  # by step: seconds and dB of each repeat that took as many steps

        @torch.no_grad()
        def observe(step: int, seconds: float, show: RenderView) -> None:
            if step in OBSERVED_STEPS:
                quality = statistics.fmean(truth.psnr(view, show(view.zoomed(scale))) for view in truth.views)
                measured.setdefault(step, []).append((seconds, quality))

        title = recipe if steps is None else f"{recipe}, {plural(steps, 'step')} at most"
        first: Adapted | None = None
        ends = list[Point]()
        for repeat in range(plan.repeats):
            settings: dict[str, Any] = {"seed": plan.seed + repeat} | ({} if steps is None else {"steps": steps})
            adapted = adapt_alone(model, scale, recipe=recipe, viewer=plan.viewer, cameras=cameras, observe=observe, **settings)
            first, report = first or adapted, adapted.report
            spent = Spread.of([report.seconds["total"]])
            end = Point(scale, "adapted", title, adapted.backend.name, report.gaussians_after, adapt_seconds=spent, ended_by=report.ended_by)
            ends.append(_measured(end, partial(_shown, adapted), truth, 1))
            bar.update()
        assert first is not None  # since there is at least one repeat
        if (recipe, steps, backend) == self._runs[0]:
            self._first = first
        intermediate, curve = replace(ends[0], ms_per_frame=None, ended_by=""), first.report.curve

        def between(step: int, values: Sequence[tuple[float, float]]) -> Point:
            splats = next((point.gaussians for point in reversed(curve) if point.step <= step), intermediate.gaussians)
            seconds, qualities = zip(*values, strict=True)
            return replace(intermediate, step=step, gaussians=splats, adapt_seconds=Spread.of(seconds), psnr_db=Spread.of(qualities))

        return [*(between(step, values) for step, values in measured.items()), _over_repeats(ends)]

    def _of_renderers(self, bar: Bar) -> list[Point]:
        """The points of the model of the first run, if there is one, or else of the base, in other renderers."""
        if self._runs and self._first is None:  # it was measured before an interruption
            self._of_run(*self._runs[0], bar)
        shown = _renderers(self._model, self._first, self._scale)
        return [_measured(point, show, self._truth, self._plan.repeats) for point, show in shown]


def on_backend(model: Wrapped, name: str) -> Wrapped:
    """The same base, rendered and adapted by another backend."""
    return Wrapped(model.model, model.cameras, name, model.trained, model.threads)


def _baselines(model: Wrapped, truth: GroundTruth, scale: float, plan: Plan) -> list[Baseline]:
    """All baselines, except those that are the truth itself."""
    found = baselines(model, scale, truth.shrink_by, filters=_filters(model), samples=plan.supersampling)
    if plan.viewer:  # which may lack the filter of the base's training: files for it are better or worse than what it shows
        found = [replace(baseline, kind="filter") if baseline.name == BASE else baseline for baseline in found]
        found.append(base_in_viewer(plan.viewer, model, scale))
    return [baseline for baseline in found if baseline.name not in truth.itself]


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
    with torch.no_grad(), threads.limited(None, shared=True):
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


def _over_repeats(ends: Sequence[Point]) -> Point:
    """The final points of all repeats as one point."""
    spreads: dict[str, Any] = {name: Spread.of([getattr(end, name).median for end in ends]) for name in ("psnr_db", "adapt_seconds", "ms_per_frame")}
    return replace(ends[0], ended_by="; ".join(dict.fromkeys(end.ended_by for end in ends)), **spreads)


def _shown(adapted: Adapted, view: Camera) -> Tensor:
    return adapted.render(view.zoomed(adapted.report.scale)).image


def _renderers(model: Wrapped, adapted: Adapted | None, scale: float) -> Iterator[tuple[Point, RenderView]]:
    """The adapted model, or else the base, rendered by the reference backend with each of RENDERERS."""
    backend = get_backend("reference")
    splats: SplatModel = adapted.model if adapted else model.model
    effects = adapted.effects if adapted else model.effects(scale)
    title = adapted.report.settings.recipe if adapted else BASE
    seconds = Spread.of([adapted.report.seconds["total"]]) if adapted else NOTHING
    count = count_of(splats, model.any_camera(), scale)
    for name, changes, dtype in RENDERERS:
        settings = replace(effects.settings, **changes)
        point = Point(scale, "renderer", f"{title}, {name}", backend.name, count, adapt_seconds=seconds)
        yield point, _render_with(backend, splats, replace(effects, settings=settings), dtype, scale)


def _render_with(backend: Backend, model: SplatModel, effects: Effects, dtype: torch.dtype, scale: float) -> RenderView:
    def show(view: Camera) -> Tensor:
        camera = view.zoomed(scale)
        with threads.limited_for(backend, None):
            return backend.render(model.gaussians(camera).to(dtype=dtype), camera, effects).image

    return show
