"""What a ladder is to be: for which viewer, from where to where, and in which steps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from numbers import Real
from typing import TYPE_CHECKING, Any

from mipmap_plugin.adaptation.start.problem import FinerLevel
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.limits import check_scale
from mipmap_plugin.recipes import recipe
from mipmap_plugin.screen_filters import COMPENSATED

if TYPE_CHECKING:
    from mipmap_plugin.frozen_base import FrozenBase

# The ratio of neighboring scales: WIDE or NARROW down to DENSE_BELOW, then NARROW, because small levels cost little. A level that was adapted to its
# band loses 3 to 4 dB at the ends of an octave where the viewer compensates or hardly dilates, and 8 dB where it dilates by 0.3 px² (lego at x1/4);
# there half an octave costs 6 dB. Lego in Spark never falls below 31.1 dB with WIDE alone, and 32.1 with NARROW below, at as many bytes.
WIDE, NARROW, DENSE_BELOW = 2**0.8, 2**0.5, 0.5

# px²: up to this dilation the wide ratio suits viewers without compensation too.
SMALL_DILATION = 0.1

# Rounding: scales within this factor are the same.
SAME = 1 + 1e-6

# The finest ratio that is tried for a bound on the quality.
FINEST_RATIO = 2**0.25

# A base that the viewer draws as its training did is the first level as it is. It is shown down to this scale: a tenth lower it would be
# about as wrong as a level at the end of its band.
BASE_REACH = 0.93

# A level's splats are in proportion to this power of its scale, and all levels below x1 together have this fraction of the base's. At x1/4, an
# eighth of lego's splats are 2 dB worse at the upper end of an octave than all of them in Spark, and no worse in PlayCanvas.
POWER, KEPT = 2 / 3, 0.5

# The part of a recipe's steps for a level that starts from a finer one, which is nearly right: lego in Spark has as many dB as with all of them.
STEPS_KEPT = 0.3

# dB: merging may cost this much before the first step, most of which steps regain: of 7 dB on lego at x1/2, all. Of 14 dB, on the demo scene,
# whose splats are few for its pixels, they regain 4, so that more splats are kept there.
MERGING_COSTS = 9.0

# dB by which a level may be worse than the finer one at its own scale, after its steps. Of scenes whose splats are large for their pixels, which no
# level needs to be made of fewer, captures lost 2 to 2.5 dB at the first switch, which is seen, and for all zooms below; small scenes 6.
MOST_LOST = 1.0

# What levels are made for; "auto" is "distance" for a viewer of STREAMING and an unbounded scene with cameras, else "zoom".
WAYS = ("auto", "zoom", "distance")

# Viewers that choose a level for each chunk by its distance.
STREAMING = ("playcanvas", "playcanvas-webgpu", "playcanvas-aa", "supersplat-viewer", "babylon")


@dataclass(frozen=True)
class LadderRequest:
    """The request for a ladder. Raises SettingsError for numbers out of range, and for an unknown recipe or setting."""

    viewer: str
    coarsest: float = 1 / 16  # the zoom down to which levels are made
    ratio: float | None = None  # of neighboring scales; None: what suits the viewer
    least_db: float | None = None  # a level that falls below this within its band is made again for a narrower one
    until_splats: int | None = None  # the first level with at most this many splats is the last
    recipe: str = "default"
    settings: Mapping[str, Any] = field(default_factory=dict)  # of AdaptConfig, for all levels
    by: str = "zoom"  # one scale for the whole scene; "distance": each splat has the scale at which the rule of a streaming viewer shows it

    def __post_init__(self) -> None:
        check_scale(self.coarsest)
        if self.coarsest > 1:
            raise SettingsError(f"coarsest: a ladder begins at x1 and goes down, but x{self.coarsest:g} is finer; give 1/16, for example")
        for name in ("ratio", "least_db", "until_splats"):
            if not isinstance(number := getattr(self, name), Real | None):
                raise SettingsError(f"{name}: must be a number, got {number!r}")
        if self.ratio is not None and not FINEST_RATIO <= self.ratio <= 4:
            raise SettingsError(f"ratio: must be from {FINEST_RATIO:.3g} to 4, such as 2, got {self.ratio:g}")
        if self.until_splats is not None and self.until_splats < 1:
            raise SettingsError(f"until_splats: must be at least 1, got {self.until_splats}")
        if self.least_db is not None and not math.isfinite(self.least_db):
            raise SettingsError(f"least_db: must be a number of dB, such as 32, got {self.least_db:g}")
        if self.by not in WAYS:
            raise SettingsError(f"by: must be one of {', '.join(WAYS)}, got {self.by}")
        if taken := {"band", "start", "viewer", "scale", "images", "most_sh_degree"} & self.settings.keys():
            raise SettingsError(f"{', '.join(sorted(taken))}: set by the ladder for each level; leave out")
        recipe(self.recipe, self.coarsest, **self.settings)  # raises before anything is read or kept

    @classmethod
    def of(cls, viewer: str, **options: Any) -> LadderRequest:
        """A request of the fields' names; further options are settings of AdaptConfig."""
        names = {each.name for each in fields(cls)} - {"settings"}
        settings = {name: value for name, value in options.items() if name not in names}
        return cls(viewer, **{name: value for name, value in options.items() if name in names}, settings=settings)

    def first_ratio(self, target: Effects) -> float:
        """The ratio to begin with, for a viewer that draws as `target`."""
        if self.ratio is not None:
            return self.ratio
        return WIDE if target.screen_filter in COMPENSATED or target.eps2d <= SMALL_DILATION else NARROW

    def first_band(self, base: FrozenBase) -> Band:
        """The band of x1."""
        target = base.target(self.viewer)
        return Band.first(self.first_ratio(target), as_it_is=target == base.effects())

    def for_first(self, base: FrozenBase, band: Band) -> dict[str, Any]:
        """The arguments of `adapt` for x1: the base as it is if the viewer draws it as its training did, else converted to the viewer."""
        return self.arguments({} if base.target(self.viewer) == base.effects() else band.settings())

    def arguments(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """The arguments of `adapt` for a level with these settings; those of the request override them.

        Levels get no SH bands beyond the base's: as many bytes of further splats are worth more, and what streams levels takes one degree only.
        """
        return {"recipe": self.recipe, "viewer": self.viewer, "most_sh_degree": 0, **settings, **self.settings}

    def next_ratio(self, shown_down_to: float, ratio: float) -> float:
        """The ratio below a level that is shown down to this zoom, after levels of the given ratio."""
        return min(ratio, NARROW) if self.ratio is None and shown_down_to < DENSE_BELOW else ratio

    def below(self, finer: FinerLevel, band: Band) -> dict[str, Any]:
        """How a level of a band is made below a finer one: from it, merged further than is good before steps. Where no step regains that, from
        the base, merged as the recipe allows, so that losses of one level are not those of the next."""
        settings = band.settings() | self.steps(band.scale)
        learns = recipe(self.recipe, band.scale, **self.settings).steps > 0
        return settings | ({"start": finer, "merging_costs": MERGING_COSTS} if learns else {})

    def steps(self, scale: float) -> dict[str, Any]:
        """The settings of AdaptConfig for the steps of a level that starts from a finer one; fewer of a large scene, unless the user settles it.

        Raises SettingsError for a setting that is unknown or out of range.
        """
        steps = math.ceil(STEPS_KEPT * recipe(self.recipe, scale).steps)
        return {"steps": steps, "most_draws": recipe(self.recipe, scale, **self.settings).most_draws}

    @property
    def seed(self) -> int:
        """Of everything random."""
        return int(self.settings.get("seed", 0))

    def facts(self) -> dict[str, Any]:
        """The request as JSON holds it."""
        return {**vars(self), "settings": dict(self.settings)}


@dataclass(frozen=True)
class Band:
    """The zooms that a level is shown at, and so is adapted to. A zoom is a focal length over that of the base."""

    scale: float
    low: float
    high: float
    ratio: float  # of this scale to the next

    @classmethod
    def first(cls, ratio: float, *, as_it_is: bool) -> Band:
        """The band of x1: up to x1 only, since nothing finer is known. `as_it_is`: of a base that the viewer draws as its training did."""
        return cls(1.0, BASE_REACH if as_it_is else ratio**-0.5, 1.0, ratio)

    def reaches(self, coarsest: float) -> bool:
        """Whether no coarser level is needed."""
        return self.low <= coarsest * SAME

    def next(self, ratio: float, coarsest: float) -> Band:
        """The band below this one; its scale is at least `coarsest`."""
        scale = max(self.low * ratio**-0.5, coarsest)
        return Band(scale, scale * ratio**-0.5, self.low, ratio)

    def settings(self) -> dict[str, Any]:
        """The settings of AdaptConfig for this band."""
        kept = KEPT * (self.ratio**POWER - 1) * self.scale**POWER  # a geometric series, whose sum is KEPT
        merging = {"merge_to": min(1.0, kept)} if self.scale < 1 else {}
        return {"band": (self.low / self.scale, self.high / self.scale), "resize": "fitting", **merging}
