"""How strongly splats are merged: which candidates are tried, and the choice among them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from mipmap_plugin.adaptation.optimization.validation import Quality
from mipmap_plugin.models.base import SplatModel

# The powers of `merge_to` that are tried: the last, the mildest, and then the others, until merging loses little enough.
POWERS = (1, 1 / 2, 1 / 4)

# The powers that are tried before those for a start from a finer level, whose splats are merged even where too few share a pixel: otherwise chair
# would keep half of them at x0.57.
COARSE_POWERS = (1, 7 / 8, 3 / 4, 5 / 8, 1 / 2)

# The powers that are tried after those where no step follows and merging gains, as of dots too small for the viewer to draw: even where too few share
# a pixel. At x0.57 in PlayCanvas a lattice of dots gains 0.6 dB by the first.
FURTHER_POWERS = (1 / 2, 3 / 4, 1)

Candidate = tuple[SplatModel, Quality]


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


class Merger(NamedTuple):
    """What merges splats as strongly as it is told, and what that may cost."""

    merge: Callable[[float, bool], Candidate | None]  # to a power of `merge_to`, whether even where too few share a pixel; None: there is no time
    least: Callable[[float], int]  # how many splats a power leaves where as many are merged as it says
    costs: float  # dB that merging may cost
    more_costs: float  # dB that the mildest merging may cost beyond that
    learns: bool  # whether steps follow, which regain what merging costs

    def strongest(self, bounds: Bounds, coarse_bounds: Bounds | None) -> SplatModel | None:
        """The candidate of the strongest merging within the bounds; None if merging costs too much.

        If the mildest merging already loses too much, as with captures, no stronger one is tried. If the mildest gains, a stronger one is tried
        even where the base as it is looks better, since it may be better than both.
        """
        if coarse_bounds and (coarse := self._first(COARSE_POWERS, True, coarse_bounds)):
            return coarse[0]
        if (mildest := self.merge(POWERS[-1], False)) is None:
            return None
        suits, gains = bounds.hold_for(mildest[1], self.more_costs), mildest[1].psnr >= bounds.formed
        if not (suits or gains):
            return None
        if not self.learns:
            bounds = bounds.beside(mildest[1], self.costs)
        found = self._first(POWERS[:-1], False, bounds) or (mildest if suits else None)
        if found and not self.learns and not coarse_bounds and found[1].psnr > bounds.formed:
            found = self._further(found, bounds)
        return found and found[0]

    def _first(self, powers: tuple[float, ...], coarsely: bool, bounds: Bounds) -> Candidate | None:
        """The first candidate within the bounds, of those that there is time for."""
        for power in powers:
            if (candidate := self.merge(power, coarsely)) is None:
                return None
            if bounds.hold_for(candidate[1]):
                return candidate
        return None

    def _further(self, found: Candidate, bounds: Bounds) -> Candidate:
        """The strongest merging beyond that of a candidate, until it costs too much beside the best; the candidate itself, if it does at once."""
        reached = len(found[0].parameters()["means"])
        for power in (each for each in FURTHER_POWERS if self.least(each) < reached):
            bounds = bounds.beside(found[1], self.costs)
            further = self.merge(power, True)
            if further is None or not bounds.hold_for(further[1]):
                break
            found = further
        return found
