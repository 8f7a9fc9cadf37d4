"""A ladder of levels: x1, and coarser and coarser files of the same scene, each adapted to the zooms that a viewer shows it at.

Every level is made from the one before, whose splats are merged; its truth is always the base. In the viewer that it is made for, a level
looks right over its band, and neighbors are equally good where a viewer should change from one to the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from mipmap_plugin import threads
from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.start.candidates import FinerLevel
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.levels.contents import Contents, CurvePoint, Level, Switch
from mipmap_plugin.levels.distance.ladder import DistanceLadder, by_distance, make_levels_by_distance
from mipmap_plugin.levels.manifest import write_ladder
from mipmap_plugin.levels.request import FINEST_RATIO, SAME, Band, LadderRequest
from mipmap_plugin.levels.store import LevelStore
from mipmap_plugin.levels.switching import switching_zoom, zooms_between
from mipmap_plugin.levels.yardstick import Yardstick
from mipmap_plugin.models.base import why_no_viewer
from mipmap_plugin.progress import announced
from mipmap_plugin.wrap import Wrapped

# Two neighboring zooms of the curve of dB are at most this factor apart.
CURVE_STEP = 2**0.25


@dataclass(frozen=True, eq=False)
class Ladder:
    """A finished ladder in memory."""

    contents: Contents
    _store: LevelStore

    @property
    def levels(self) -> list[Level]:
        """From the finest to the coarsest."""
        return self.contents.levels

    def save(self, folder: str | Path, *, overwrite: bool = False, keep_resume: bool = False) -> Path:
        """Write the levels and the manifest `levels.json` to a folder, atomically; return it. Raises OutputExists, OutputError.

        `keep_resume`: leave what was kept to go on from until `forget`.
        """
        saved = write_ladder(self.contents, Path(folder), overwrite)
        if not keep_resume:
            self.forget()
        return saved

    def forget(self) -> None:
        """Delete what was kept to go on from."""
        self._store.remove()


def make_levels(base: Wrapped, request: LadderRequest, resume: str | Path | None = None) -> Ladder | DistanceLadder:
    """Make the levels. `resume`: a folder for finished levels, to go on from after an interruption; saving the ladder removes it.

    Raises SettingsError for a model that no viewer draws and for a group of viewers, BackendUnavailable, Interrupted.
    """
    if reason := why_no_viewer(base.model):
        raise SettingsError(f"{base.model.family}: {reason}; levels are files for viewers, so adapt it to one scale at a time")
    if by_distance(base, request):
        return make_levels_by_distance(base, request, resume)
    with threads.limited(base.threads, shared=False):
        return _make_levels(base, request, resume)


def _make_levels(base: Wrapped, request: LadderRequest, resume: str | Path | None) -> Ladder:
    """`make_levels` by zoom."""
    band = request.first_band(base.target(request.viewer), base.effects())
    store = LevelStore(None if resume is None else Path(resume), base, request)
    with announced("rendering the base"):
        yardstick = Yardstick(base, request.seed)
    work = _Work(base, request, store, yardstick)
    levels, ratio = [work.first(band)], band.ratio
    while not work.ends(levels[-1]):
        level, ratio = work.next(levels, ratio)
        levels.append(level)
    with announced("measuring the levels"):
        switches = _switches(levels, yardstick)
        edges = [1.0, *(switch.zoom for switch in switches), max(request.coarsest, levels[-1].band.low)]
        curve = _curve(levels, edges, yardstick, lambda zoom: yardstick.psnr_of_base(base, request.viewer, zoom))
    return Ladder(Contents(request, base, levels, switches, curve), store)


@dataclass(frozen=True, eq=False)
class _Work:
    """What levels are made from, kept in and judged by."""

    base: Wrapped
    request: LadderRequest
    store: LevelStore
    yardstick: Yardstick

    def first(self, band: Band) -> Level:
        """x1: the base, converted to the viewer unless that draws it as its training did."""
        as_it_is = self.base.target(self.request.viewer) == self.base.effects()
        return self._made("level_0", band, {} if as_it_is else band.settings())

    def next(self, levels: Sequence[Level], ratio: float) -> tuple[Level, float]:
        """The level below the last one, and the ratio of its band; a level that is not good enough is made again for a narrower band."""
        last = levels[-1]
        start, ratio = FinerLevel(last.adapted.model, last.band.scale), self.request.next_ratio(last.band.low, ratio)
        while True:
            band = last.band.next(ratio, self.request.coarsest)
            settings = band.settings() | {"start": start, **self.request.steps(band.scale)}
            level = self._made(f"level_{len(levels)}_x{band.scale:.6g}", band, settings)
            narrower = ratio**0.5
            if self._suffices(level) or narrower * SAME < FINEST_RATIO:
                return level, ratio
            ratio = narrower

    def ends(self, last: Level) -> bool:
        """Whether the ladder needs no further level."""
        few = self.request.until_splats is not None and last.splats <= self.request.until_splats
        return few or last.band.reaches(self.request.coarsest)

    def _made(self, name: str, band: Band, settings: dict[str, object]) -> Level:
        request = self.request
        options = {"recipe": request.recipe, "viewer": request.viewer, **settings, **request.settings}

        def make(state: Path | None) -> Adapted:
            return self.base.adapt(band.scale, resume=state, **options)

        return Level(self.store.level(name, make), band)

    def _suffices(self, level: Level) -> bool:
        """Whether a level is as good as requested at the ends of its band."""
        least = self.request.least_db
        return least is None or min(self.yardstick.psnr(level.adapted, zoom) for zoom in (level.band.low, level.band.high)) >= least


def _switches(levels: Sequence[Level], yardstick: Yardstick) -> list[Switch]:
    """The best zooms to change between neighboring levels."""
    switches = []
    for finer, coarser in pairwise(levels):

        def measure(zoom: float, pair: tuple[Level, Level] = (finer, coarser)) -> tuple[float, float]:
            return yardstick.psnr(pair[0].adapted, zoom), yardstick.psnr(pair[1].adapted, zoom)

        zoom = switching_zoom(coarser.band.scale, finer.band.scale, measure)
        switches.append(Switch(zoom, yardstick.psnr(finer.adapted, zoom), yardstick.likeness(finer.adapted, coarser.adapted, zoom)))
    return switches


def _curve(levels: Sequence[Level], edges: Sequence[float], yardstick: Yardstick, base_db: Callable[[float], float]) -> list[CurvePoint]:
    """The quality at falling zooms, of the level that is shown at each. `edges`: the ends of the levels' zooms, one more than levels."""
    return [
        CurvePoint(zoom, number, yardstick.psnr(level.adapted, zoom), base_db(zoom))
        for number, (level, high, low) in enumerate(zip(levels, edges, edges[1:], strict=False))
        for zoom in reversed(zooms_between(min(low, high), high, CURVE_STEP))
    ]
