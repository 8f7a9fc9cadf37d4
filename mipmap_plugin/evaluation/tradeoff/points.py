"""What accuracy costs: one scene at one scale through recipes, steps, backends and renderer settings, beside every answer that
needs no adapting. Measuring quality is not billed as adapting, and no view that is judged on is adapted to."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from mipmap_plugin.backends import get_backend
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import USUAL, Effects, RenderSettings
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation.measure import BASE, FILTERS, RESIZED, Kind, Rival, Show, base_in, rivals, warm_up, warm_watch
from mipmap_plugin.evaluation.tradeoff.truth import Yardstick
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.splatting.filters import SCREEN_FILTERS
from mipmap_plugin.wrap import Adapted, Wrapped

# Steps after which a run is looked at: even on the logarithmic axis of time.
LOOKS = (0, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)

# What a renderer may save, each alone: (name, settings, float type).
RENDERERS: tuple[tuple[str, RenderSettings, torch.dtype], ...] = (
    ("as usual", USUAL, torch.float32),
    ("float64", USUAL, torch.float64),
    *((f"alpha from {name}", replace(USUAL, min_alpha=1 / least), torch.float32) for name, least in (("1/64", 64), ("1/16", 16))),
    *((f"stop at {least:g}", replace(USUAL, min_transmittance=least), torch.float32) for least in (0.01, 0.1)),
    *((f"radius {radius:g}", replace(USUAL, radius=radius), torch.float32) for radius in (3.0, 2.0)),
    *((f"tile {tile}", replace(USUAL, tile=tile), torch.float32) for tile in (8, 32)),
)  # fmt: skip


@dataclass(frozen=True)
class Spread:
    """Several measurements of one thing."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        return cls(statistics.median(values), min(values), max(values))


NOTHING = Spread(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Point:
    """One way to show a scene at one scale: what it costs, and how good it is."""

    scale: float
    kind: Kind
    name: str
    backend: str
    gaussians: int
    psnr_db: Spread = NOTHING
    adapt_seconds: Spread = NOTHING
    ms_per_frame: Spread | None = None  # None on the way, before a run has ended
    step: int | None = None  # on the way
    ended_by: str = ""  # at the end of a run; where repeats differ, all reasons


@dataclass(frozen=True)
class Plan:
    """What is tried."""

    recipes: Sequence[str] = ("default",)
    steps: Sequence[int | None] = ()  # none: as many as each recipe says
    backends: Sequence[str] = ("auto",)
    supersampling: Sequence[int] = (2, 4, 8)
    renderers: bool = True  # the settings of RENDERERS, on the first run's model
    repeats: int = 3
    seed: int = 0  # of the first repeat; each has the next
    viewer: str | None = None  # what files are adapted for, and the base is drawn by too

    def __post_init__(self) -> None:
        if self.repeats < 1 or any(n < 2 for n in self.supersampling):
            raise SettingsError("a tradeoff needs repeats of at least 1, and supersampling of at least 2 x 2 samples")


def measure(model: Wrapped, yardstick: Yardstick, scale: float, plan: Plan) -> Iterator[Point]:
    """Each point as soon as it is measured. Raises SettingsError and BackendUnavailable."""
    runs = [(name, steps, backend) for backend in plan.backends for name in plan.recipes for steps in plan.steps or (None,)]
    free = [rival for backend in plan.backends for rival in _rivals(on_backend(model, backend), yardstick, scale, plan)]
    count = len(model.model.gaussians(model.any_camera()))
    bar = tqdm(total=len(free) + len(runs) * plan.repeats + len(RENDERERS) * plan.renderers, disable=None, desc=f"tradeoff x{scale:g}")
    first: Adapted | None = None
    with bar:
        for rival in free:
            yield _judged(Point(scale, rival.kind, rival.name, rival.backend, count), rival.show, yardstick, plan.repeats)
            bar.update()
        for backend in plan.backends if runs else ():
            warm_up(on_backend(model, backend), scale, yardstick.adapt_on)
        for name, steps, backend in runs:
            points, adapted = _run(on_backend(model, backend), yardstick, scale, plan, (name, steps), bar)
            yield from points
            first = first or adapted
        for point, show in _renderers(model, first, scale) if plan.renderers else ():
            yield _judged(point, show, yardstick, plan.repeats)
            bar.update()


def on_backend(model: Wrapped, name: str) -> Wrapped:
    """The same base, rendered and adapted by another backend."""
    return Wrapped(model.model, model.cameras, name, model.trained, model.threads)


def _rivals(model: Wrapped, yardstick: Yardstick, scale: float, plan: Plan) -> list[Rival]:
    """Everything that needs no adapting, but what is the truth itself."""
    found = rivals(model, scale, yardstick.shrink_by, filters=_filters(model), samples=plan.supersampling)
    found += [base_in(plan.viewer, model, scale)] if plan.viewer else []
    return [rival for rival in found if not (yardstick.is_resized_base and rival.name == RESIZED)]


def _filters(model: Wrapped) -> list[str]:
    """Every filter but the one that the model was trained with: first those of every table."""
    return [name for name in (*FILTERS, *sorted(SCREEN_FILTERS - set(FILTERS))) if name != model.trained.screen_filter]


def left_out(model: Wrapped, plan: Plan) -> list[str]:
    """The filters that a backend of the plan lacks, in sentences."""
    on = [on_backend(model, name) for name in plan.backends]
    return [f"there is no {name} filter, since {why}" for each in on for name in _filters(each) if (why := each.lacks(name))]


def _judged(point: Point, show: Show, yardstick: Yardstick, repeats: int) -> Point:
    """`point` with its dB and its milliseconds a frame, the mean over the views in each repeat."""
    times, decibels = [], []
    with torch.no_grad():
        watch = warm_watch(show, yardstick.views[0])
        for repeat in range(repeats):
            watch.seconds = 0.0
            for view in yardstick.views:
                with watch:
                    image = show(view)
                if repeat == 0:
                    decibels.append(yardstick.psnr(view, image))
            times.append(1000 * watch.seconds / len(yardstick.views))
    return replace(point, psnr_db=Spread.of([statistics.fmean(decibels)]), ms_per_frame=Spread.of(times))


def _run(
    model: Wrapped, yardstick: Yardstick, scale: float, plan: Plan, run: tuple[str, int | None], bar: tqdm
) -> tuple[list[Point], Adapted]:
    """The points of a recipe, of so many steps, on its way and at its end, over all repeats, and the first repeat's model."""
    recipe, steps = run
    way: dict[int, list[tuple[float, float]]] = {}  # after so many steps: seconds and dB of each repeat that went so far

    @torch.no_grad()
    def look(step: int, seconds: float, show: Show) -> None:
        if step in LOOKS:
            quality = statistics.fmean(yardstick.psnr(view, show(view.zoomed(scale))) for view in yardstick.views)
            way.setdefault(step, []).append((seconds, quality))

    runs, ends = [], []
    for repeat in range(plan.repeats):
        settings: dict[str, Any] = {"seed": plan.seed + repeat} | ({} if steps is None else {"steps": steps})
        runs.append(adapted := model.adapt(scale, recipe=recipe, viewer=plan.viewer, cameras=yardstick.adapt_on, observe=look, **settings))
        report = adapted.report
        end = Point(scale, "adapted", _name(recipe, steps), adapted.backend.name, report.gaussians_after, ended_by=report.ended_by)
        ends.append(_judged(replace(end, adapt_seconds=Spread.of([report.seconds["total"]])), _shows(adapted, scale), yardstick, 1))
        bar.update()
    on_the_way = replace(ends[0], ms_per_frame=None, ended_by="")
    points = [
        replace(on_the_way, step=step, **_spreads(adapt_seconds=[seconds for seconds, _ in seen], psnr_db=[quality for _, quality in seen]))
        for step, seen in way.items()
    ]
    return [*points, _over_repeats(ends)], runs[0]


def _name(recipe: str, steps: int | None) -> str:
    return recipe if steps is None else f"{recipe}, {steps} steps at most"


def _spreads(**values: Sequence[float]) -> dict[str, Any]:
    return {name: Spread.of(each) for name, each in values.items()}


def _over_repeats(ends: Sequence[Point]) -> Point:
    """One point from those of all repeats."""
    measured = {name: [getattr(end, name).median for end in ends] for name in ("psnr_db", "adapt_seconds", "ms_per_frame")}
    return replace(ends[0], ended_by="; ".join(dict.fromkeys(end.ended_by for end in ends)), **_spreads(**measured))


def _shows(adapted: Adapted, scale: float) -> Show:
    return lambda view: adapted.render(view.zoomed(scale)).image


def _renderers(model: Wrapped, adapted: Adapted | None, scale: float) -> Iterator[tuple[Point, Show]]:
    """The adapted model, or the base without one, drawn by the reference backend with each of RENDERERS."""
    backend = get_backend("reference")
    shown: SplatModel = adapted.model if adapted else model.model
    effects = adapted.effects if adapted else model.effects(scale)
    who = adapted.report.settings.recipe if adapted else BASE
    seconds = Spread.of([adapted.report.seconds["total"]]) if adapted else NOTHING
    count = len(shown.gaussians(model.any_camera()))
    for name, settings, dtype in RENDERERS:
        point = Point(scale, "renderer", f"{who}, {name}", backend.name, count, adapt_seconds=seconds)
        yield point, _drawn(backend, shown, replace(effects, settings=settings), dtype, scale)


def _drawn(backend: Backend, model: SplatModel, effects: Effects, dtype: torch.dtype, scale: float) -> Show:
    def show(view: Camera) -> Tensor:
        camera = view.zoomed(scale)
        return backend.render(model.gaussians(camera).to(dtype=dtype), camera, effects).image

    return show
