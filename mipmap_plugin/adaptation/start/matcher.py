"""Matches the opacities of a start's candidates to the base's blend weights, in as many rounds as there is time for."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from mipmap_plugin.adaptation.start.base_weights import BaseWeights
from mipmap_plugin.adaptation.start.blend_weights import blend_weights
from mipmap_plugin.adaptation.start.clock import Clock
from mipmap_plugin.adaptation.start.closed_form import filter_suffices
from mipmap_plugin.adaptation.start.matching import ROUNDS, matched_opacities
from mipmap_plugin.adaptation.start.problem import StartProblem
from mipmap_plugin.camera import evenly
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
        self.rounds = ROUNDS  # as many as are wanted
        spreads = problem.target.screen_filter == SURFEL or problem.target.screen_filter in INTEGRATED  # otherwise than by a variance in px²
        suffices = filter_suffices(problem.base_effects, problem.target)
        self.is_of_use = problem.has_blend_weights and not suffices and (problem.scale <= 1 or not spreads)

    def rounds_for(self, weights: Tensor | None) -> int:
        """How many rounds there are: none without blend weights, and no more than there is time for."""
        rounds = wanted = self.rounds if self.is_of_use and weights is not None else 0
        while rounds and not self._clock.allows("weights", rounds):
            rounds -= 1
        if rounds == 0 < wanted and UNMATCHED not in self._seen.notes:
            self._seen.notes.append(UNMATCHED)
        return rounds

    def matched(self, splats: Gaussians, weights: Tensor, whole: Tensor, rounds: int) -> Tensor:
        """The opacities [N] of splats in closed form, for these blend weights [N]; `whole` [N]: those of the base if nothing hid it."""
        problem = self._problem
        size = min(self._seen.size, problem.scale)  # a zoom-in is weighed in images of the base's size: sums over pixels need no finer ones
        finer = problem.scale / size
        target = replace(problem.target, eps2d=problem.target.eps2d / finer**2, settings=problem.target.settings.finer(1 / finer))
        views = [view.zoomed(size) for view in evenly(problem.views, self._seen.count)]

        def weights_of(opacities: Tensor) -> Tensor:
            return blend_weights(replace(splats, opacities=opacities), views, problem.backend, target) * finer**2

        return matched_opacities(splats.opacities, weights, whole, weights_of, rounds)
