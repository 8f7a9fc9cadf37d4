"""A ladder of levels: x1, and coarser and coarser files of the same scene, each adapted to the zooms that a viewer shows it at.

Every level is made from the one before, whose splats are merged; without steps, which would regain what that costs, from the base. Its truth is
always the base. In the viewer that it is made for, a level looks right over its band, and neighbors are equally good where a viewer should change
from one to the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from mipmap_plugin.adaptation.start.base_weights import ON_HIDDEN
from mipmap_plugin.adaptation.start.problem import FinerLevel
from mipmap_plugin.adaptation.warn import held, warn
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.frozen_base import FrozenBase
from mipmap_plugin.levels.contents import Contents, LeftOut, Level, Switch, ZoomPoint
from mipmap_plugin.levels.distance.ladder import by_distance, make_levels_by_distance
from mipmap_plugin.levels.finished import Ladder
from mipmap_plugin.levels.manifest import manifest
from mipmap_plugin.levels.request import FINEST_RATIO, MOST_LOST, SAME, Band, LadderRequest
from mipmap_plugin.levels.store import LevelStore
from mipmap_plugin.levels.switching import EVEN, SECOND_STEP, switching_zoom, zooms_between
from mipmap_plugin.levels.yardstick import Yardstick
from mipmap_plugin.limits import path_of
from mipmap_plugin.models.base import SplatModel, why_no_viewer
from mipmap_plugin.process import threads
from mipmap_plugin.progress import announced
from mipmap_plugin.recipes import recipe

# Two neighboring zooms of the curve of dB are at most this factor apart.
CURVE_STEP = 2**0.25

# A level with more than this part of the finer one's splats costs a viewer as much. One with 1,987 of 1,996 was 1 dB worse, and below the base.
FEWER = 0.9

# A level that is shown from one zoom to another that is nearer than this, as a factor, is left out: a switch is not found more closely, and what
# shows levels leaves one a little beyond its end (`levels.js` by 1.02).
SLIVER = SECOND_STEP**2

# Why a level is left out.
NOT_BETTER = "adapting gave nothing better than the base as it is"
NO_FEWER = "it is no better there than the finer level, and has hardly fewer splats"
UNSHOWN = "at every zoom a neighbor is as good"


def refuse_no_viewer(model: SplatModel) -> None:
    """Raise SettingsError for a model that no viewer draws."""
    if reason := why_no_viewer(model):
        raise SettingsError(f"{model.family}: {reason}; levels are files for viewers, so adapt it to one scale at a time")


def make_levels(base: FrozenBase, request: LadderRequest, resume: str | Path | None = None) -> Ladder:
    """Make the levels. `resume`: a folder for finished levels, to go on from after an interruption; saving the ladder removes it.

    Raises SettingsError for a model that no viewer draws, for views that show nothing and for a group of viewers, BackendUnavailable, Interrupted.
    """
    folder = None if resume is None else path_of(resume, "resume")
    refuse_no_viewer(base.model)
    base.refuse_undrawn()
    if by_distance(base, request):
        return make_levels_by_distance(base, request, folder)
    with threads.limited_for(base.backend(viewer=request.viewer)[0], base.threads):
        return _make_levels_by_zoom(base, request, folder)


def _make_levels_by_zoom(base: FrozenBase, request: LadderRequest, resume: Path | None) -> Ladder:
    band = request.first_band(base)
    store = LevelStore(resume, base, request)
    with announced("rendering the base"):
        yardstick = Yardstick(base, request.seed)
    work = _Work(base, request, store, yardstick)
    made, unused, lowest = work.levels(band)
    with announced("measuring the levels"):
        end = max(request.coarsest, lowest)
        levels, switches, unshown = _shown(made, yardstick, end)
        edges = [1.0, *(switch.zoom for switch in switches), end]
        curve = _curve(levels, edges, yardstick, lambda zoom: yardstick.psnr_of_base(request.viewer, zoom))
    left_out = sorted([*unused, *unshown], key=lambda level: -level.scale)
    return Ladder(Contents(request, base, levels, switches, curve, left_out), store, manifest)


@dataclass(frozen=True, eq=False)
class _Work:
    """What levels are made from, kept in and judged by."""

    base: FrozenBase
    request: LadderRequest
    store: LevelStore
    yardstick: Yardstick
    said: list[str] = field(default_factory=list)  # what the level that was made last warned of
    told: list[str] = field(default_factory=list)  # what was warned of

    def levels(self, band: Band) -> tuple[list[Level], list[LeftOut], float]:
        """The levels, those that are left out because they are no use as coarser ones, and the zoom down to which there was one made."""
        first = self._made("level_0", band, self.request.for_first(self.base, band))
        self._tell()
        levels, left_out, ratio = [first], list[LeftOut](), band.ratio
        while not self._ends(levels[-1], band):
            level, ratio = self._next(levels[-1], band, len(levels) + len(left_out), ratio)
            band, reason = level.band, _no_use(level, levels[-1], self.yardstick)
            if reason is None:
                levels.append(level)
                self._tell()
            else:
                left_out.append(LeftOut(band.scale, level.splats, reason))
        return levels, left_out, band.low

    def _next(self, finer: Level, above: Band, number: int, ratio: float) -> tuple[Level, float]:
        """The level for the band below `above` and the finer one, and its ratio; one that is not good enough is made again for a narrower band."""
        start, ratio = FinerLevel(finer.adapted.model, finer.band.scale), self.request.next_ratio(above.low, ratio)
        while True:
            band = above.next(ratio, self.request.coarsest)
            level = self._below(finer, f"level_{number}_x{band.scale:.6g}", band, self.request.arguments(self.request.below(start, band)))
            narrower = ratio**0.5
            if self._suffices(level) or narrower * SAME < FINEST_RATIO:
                return level, ratio
            ratio = narrower

    def _below(self, finer: Level, name: str, band: Band, arguments: dict[str, Any]) -> Level:
        """A level below a finer one. Where steps regained too little of what merging cost, it is made again, merged as the recipe allows."""
        level = self._made(name, band, arguments)
        merged_further = "start" in arguments and "merging_costs" not in self.request.settings
        if not merged_further or not self._merged_too_far(finer, level):
            return level
        return self._made(f"{name}_merged_less", band, {**arguments, "merging_costs": recipe(self.request.recipe, band.scale).merging_costs})

    def _merged_too_far(self, finer: Level, level: Level) -> bool:
        """Whether a level is so much worse than the finer one at its own scale, or worse than that and than the base as the viewer draws it."""
        zoom = level.band.scale
        lost = _better(self.yardstick, finer, level, zoom)
        if lost <= EVEN or lost > MOST_LOST:
            return lost > MOST_LOST
        return self.yardstick.psnr(level.adapted, zoom) < self.yardstick.psnr_of_base(self.request.viewer, zoom)

    def _ends(self, coarsest: Level, last: Band) -> bool:
        """Whether the ladder needs no level below its coarsest one, after the band that was the last to be adapted to."""
        few = self.request.until_splats is not None and coarsest.splats <= self.request.until_splats
        return few or last.reaches(self.request.coarsest)

    def _made(self, name: str, band: Band, arguments: dict[str, Any]) -> Level:
        with held() as said:
            level = Level(self.store.level(name, lambda state: self.base.adapt(band.scale, resume=state, **arguments)), band)
        self.said[:] = said
        return level

    def _tell(self) -> None:
        """Warn of what the level that was made last warned of, now that it is kept. That no view shows many splats is said of the scene, once."""
        for text in self.said:
            if not (text.endswith(ON_HIDDEN) and any(told.endswith(ON_HIDDEN) for told in self.told)):
                warn(text)
                self.told.append(text)

    def _suffices(self, level: Level) -> bool:
        """Whether a level is as good as requested at the ends of its band."""
        least = self.request.least_db
        return least is None or min(self.yardstick.psnr(level.adapted, zoom) for zoom in (level.band.low, level.band.high)) >= least


def _better(yardstick: Yardstick, level: Level, other: Level, zoom: float) -> float:
    """By how many dB a level is better than another one at a zoom."""
    return yardstick.psnr(level.adapted, zoom) - yardstick.psnr(other.adapted, zoom)


def _no_use(level: Level, finer: Level, yardstick: Yardstick) -> str | None:
    """Why a level is no use below a finer one: it costs a viewer as much, and is no better at its own scale; None if it is."""
    if level.splats <= FEWER * finer.splats or _better(yardstick, level, finer, level.band.scale) > EVEN:
        return None
    return NOT_BETTER if level.adapted.report.holds_base() else NO_FEWER


def _shown(levels: list[Level], yardstick: Yardstick, end: float) -> tuple[list[Level], list[Switch], list[LeftOut]]:
    """The levels that are shown at some zoom, the switches between them, and what is left out because its two switches are nearly one.

    `end`: the zoom at which the ladder ends.
    """
    left_out = list[LeftOut]()
    while True:
        switches = _switches(levels, yardstick, end)
        number = next((number for number, (to, start) in enumerate(pairwise(switches), 1) if to.zoom <= start.zoom * SLIVER), None)
        if number is None:
            return levels, switches, left_out
        unshown = levels[number]
        left_out.append(LeftOut(unshown.band.scale, unshown.splats, UNSHOWN))
        levels = [level for level in levels if level is not unshown]


def _switches(levels: Sequence[Level], yardstick: Yardstick, end: float) -> list[Switch]:
    """The best zooms to change between neighboring levels. Each is sought between the scales of the two, with two exceptions.

    Where the coarser level is better at the finer one's own scale, as merged splats may be where a viewer draws no small ones, it is sought above
    both. Where the finer one is better at the coarser one's scale, it is sought down to the end of the coarser one's band. `end`: of the ladder.
    """
    switches = []
    for above, (finer, coarser) in zip([levels[0], *levels], pairwise(levels), strict=False):

        def measure(zoom: float, pair: tuple[Level, Level] = (finer, coarser)) -> tuple[float, float]:
            return yardstick.psnr(pair[0].adapted, zoom), yardstick.psnr(pair[1].adapted, zoom)

        low, high = coarser.band.scale, finer.band.scale
        if _better(yardstick, coarser, finer, high) > EVEN:
            low, high = high, above.band.scale
        elif _better(yardstick, finer, coarser, low) > EVEN:
            low = min(low, max(coarser.band.low, end))
        zoom = switching_zoom(low, high, measure)
        before, after = measure(zoom)
        switches.append(Switch(zoom, before, before - after, yardstick.likeness(finer.adapted, coarser.adapted, zoom)))
    return switches


def _curve(levels: Sequence[Level], edges: Sequence[float], yardstick: Yardstick, base_db: Callable[[float], float]) -> list[ZoomPoint]:
    """The quality at falling zooms, of the level that is shown at each. `edges`: the ends of the levels' zooms, one more than levels."""
    return [
        ZoomPoint(zoom, number, yardstick.psnr(level.adapted, zoom), base_db(zoom))
        for number, (level, high, low) in enumerate(zip(levels, edges, edges[1:], strict=False))
        for zoom in reversed(zooms_between(min(low, high), high, CURVE_STEP))
    ]
