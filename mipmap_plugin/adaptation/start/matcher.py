"""Matches the opacities of a start's candidates to the base's blend weights, in as many sweeps over the views as there is time for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from mipmap_plugin.adaptation.pixel_size import LEAST_VIEWS
from mipmap_plugin.adaptation.start.base_weights import BaseWeights
from mipmap_plugin.adaptation.start.blend_weights import blend_weights
from mipmap_plugin.adaptation.start.clock import Clock
from mipmap_plugin.adaptation.start.closed_form import filter_suffices
from mipmap_plugin.adaptation.start.matching import Sweeps, Wanted, matched_opacities, sweeps_over
from mipmap_plugin.adaptation.start.problem import StartProblem
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import SURFEL
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.screen_filters import INTEGRATED

# What is said where a time budget ended before opacities were matched, which gains some dB.
UNMATCHED = "the time budget left no time to fit opacities to what splats show in the base's images, so that the start has less dB than it could"


class Matcher:
    """Matches opacities (`matched_opacities`)."""

    def __init__(self, problem: StartProblem, clock: Clock, seen: BaseWeights) -> None:
        """`seen`: says in which views, and at which size, weights are measured; its notes tell where there was no time."""
        self._problem, self._clock, self._seen = problem, clock, seen
        self.wanted: tuple[int, ...] | None = None  # the sweeps; None: the usual ones
        spreads = problem.target.screen_filter == SURFEL or problem.target.screen_filter in INTEGRATED  # otherwise than by a variance in px²
        suffices = filter_suffices(problem.base_effects, problem.target)
        self.is_of_use = problem.has_blend_weights and not suffices and (problem.scale <= 1 or not spreads)

    @property
    def sweeps(self) -> Sweeps:
        """Those over the views that splats are weighed in."""
        return sweeps_over(self._views())

    def sweeps_for(self, weights: Tensor | None) -> tuple[int, ...]:
        """The sweeps that are made: none without blend weights, and no more than there is time for."""
        if not self.is_of_use or weights is None:
            return ()
        sweeps = wanted = self.sweeps.usual if self.wanted is None else self.wanted
        while sweeps and not self.allows(weights, sweeps):
            sweeps = sweeps[:-1]
        if wanted and not sweeps and UNMATCHED not in self._seen.notes:
            self._seen.notes.append(UNMATCHED)
        return sweeps

    def allows(self, weights: Tensor, sweeps: Sequence[int]) -> bool:
        """Whether there is time for such sweeps over splats of these weights [N, P]: in less of it than the base's if these and pixels are fewer."""
        share = max(len(weights) / len(self._seen.of_base.whole), (self._size / self._seen.size) ** 2)
        return self._clock.allows("weights", share * len(sweeps) * len(self._seen.views) / LEAST_VIEWS)

    def matched(self, splats: Gaussians, wanted: Wanted, sweeps: Sequence[int]) -> Tensor:
        """The opacities [N] of splats in closed form, for what is wanted of them."""
        problem, views = self._problem, self._views()
        finer = problem.scale / self._size
        target = replace(problem.target, eps2d=problem.target.eps2d / finer**2, settings=problem.target.settings.finer(1 / finer))

        def weights_of(opacities: Tensor, part: int, parts: int) -> Tensor:
            some = views[part::parts]
            return blend_weights(replace(splats, opacities=opacities), some, problem.backend, target) * (finer**2 * len(some) / len(views))

        return matched_opacities(splats.opacities, wanted, weights_of, sweeps)

    @property
    def _size(self) -> float:
        """The fraction of their size at which views are weighed: a zoom-in in images of the base's size, for sums over pixels need no finer ones."""
        return min(self._seen.size, self._problem.scale)

    def _views(self) -> list[Camera]:
        return [view.zoomed(self._size) for view in self._seen.views]
