"""How strongly splats are merged, as a whole and in tiles: which candidates are tried, and the choice among them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

from mipmap_plugin.adaptation.optimization.validation import Quality
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects

# The powers of `merge_to` that are tried: the last, the mildest, and then the others, until merging loses little enough.
POWERS = (1, 1 / 2, 1 / 4)

# The powers that are tried before those for a start from a finer level, whose splats are merged even where too few share a pixel: otherwise chair
# would keep half of them at x0.57.
COARSE_POWERS = (1, 7 / 8, 3 / 4, 5 / 8, 1 / 2)

# The powers that are tried next if no step follows and merging gains, as with dots that are too small for the viewer to draw: then splats are merged
# even where too few share a pixel. At x0.57 in PlayCanvas a lattice of dots gains 0.6 dB by the first.
FURTHER_POWERS = (1 / 2, 3 / 4, 1)

# dB that the mildest merging may cost before steps for a renderer that draws otherwise than the training did, even if the settings allow less: fewer
# splats learn that sooner, and better. What stronger merging costs does not come back (docs/recipes_found.md).
MILD_COSTS = 0.6

Made = TypeVar("Made")


@dataclass(frozen=True)
class Candidate(Generic[Made]):
    """Merged splats."""

    made: Made  # a model, or where it lies
    quality: Quality
    count: int  # of its splats


class Bounds(NamedTuple):
    """The least dB of a candidate."""

    psnr: float
    visible: float
    formed: float  # of the closed form, before merging

    def hold_for(self, quality: Quality, more: float = 0.0) -> bool:
        """Whether a candidate of this quality is good enough; its `psnr` may be lower by `more` dB."""
        return quality.psnr >= self.psnr - more and quality.visible >= self.visible

    def beside(self, quality: Quality, costs: float) -> Bounds:
        """These, for candidates that may also be worse than one of this quality by no more than `costs` dB."""
        return self._replace(psnr=max(self.psnr, quality.psnr - costs))


class MergingCosts(NamedTuple):
    """dB that merging may cost."""

    usual: float
    mildest: float  # what the mildest merging may
    learns: bool  # whether steps follow, which regain what merging costs

    @classmethod
    def of(cls, config: AdaptConfig, base: Effects, target: Effects) -> MergingCosts:
        """Those of a run. `base`, `target`: how the base and the adapted file are rendered."""
        usual, learns = config.merging_costs, config.steps > 0
        return cls(usual, max(usual, MILD_COSTS) if learns and base != target and usual else usual, learns)


@dataclass(frozen=True)
class Merger(Generic[Made]):
    """What merges splats as strongly as it is told, and what that may cost."""

    # to a power of `merge_to`, whether even where too few share a pixel; None: there is no time
    merge: Callable[[float, bool], Candidate[Made] | None]
    least: Callable[[float], int]  # how many splats a power leaves where as many are merged as it says
    costs: MergingCosts

    def strongest(self, bounds: Bounds, coarse_bounds: Bounds | None = None) -> Candidate[Made] | None:
        """The candidate of the strongest merging within the bounds; None if merging costs too much.

        If the mildest merging already loses too much, as with captures, no stronger one is tried. If the mildest gains, a stronger one is tried
        even where the base as it is looks better, since it may be better than both.
        """
        if coarse_bounds and (coarse := self._first(COARSE_POWERS, True, coarse_bounds)):
            return coarse
        if (mildest := self.merge(POWERS[-1], False)) is None:
            return None
        suits, gains = bounds.hold_for(mildest.quality, self.costs.mildest - self.costs.usual), mildest.quality.psnr >= bounds.formed
        if not (suits or gains):
            return None
        if not self.costs.learns:
            bounds = bounds.beside(mildest.quality, self.costs.usual)
        found = self._first(POWERS[:-1], False, bounds) or (mildest if suits else None)
        if found and not self.costs.learns and not coarse_bounds and found.quality.psnr > bounds.formed:
            found = self._further(found, bounds)
        return found

    def _first(self, powers: tuple[float, ...], coarsely: bool, bounds: Bounds) -> Candidate[Made] | None:
        """The first candidate within the bounds, of those that there is time for."""
        for power in powers:
            if (candidate := self.merge(power, coarsely)) is None:
                return None
            if bounds.hold_for(candidate.quality):
                return candidate
        return None

    def _further(self, found: Candidate[Made], bounds: Bounds) -> Candidate[Made]:
        """The strongest merging beyond that of a candidate, until it costs too much beside the best; the candidate itself, if it does at once."""
        reached = found.count
        for power in (each for each in FURTHER_POWERS if self.least(each) < reached):
            bounds = bounds.beside(found.quality, self.costs.usual)
            further = self.merge(power, True)
            if further is None or not bounds.hold_for(further.quality):
                break
            found = further
        return found
