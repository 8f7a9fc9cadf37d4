"""The candidates for a start: the base in closed form, with all of its splats or after merging them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import cast

from torch import Tensor

from mipmap_plugin.adaptation.optimization.amount import takes_steps
from mipmap_plugin.adaptation.start.base_weights import BaseWeights
from mipmap_plugin.adaptation.start.blend_weights import Wanted
from mipmap_plugin.adaptation.start.clock import Clock
from mipmap_plugin.adaptation.start.closed_form import AREA_POWER, LEAST_AXIS, FormSettings, closed_form
from mipmap_plugin.adaptation.start.matching import Matcher
from mipmap_plugin.adaptation.start.merging import MergingRounds, merge_down, merge_seen
from mipmap_plugin.adaptation.start.problem import StartProblem
from mipmap_plugin.adaptation.start.thinning import evenly_in_space
from mipmap_plugin.adaptation.views.pixel_size import mean_pixel_size
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SPLATS, SplatModel, Thinned, means_at
from mipmap_plugin.models.contract import rebuild, reshape


class Candidates:
    """Makes candidates; a search may change how they are formed from one to the next."""

    def __init__(self, problem: StartProblem, clock: Clock) -> None:
        self._problem, self._clock, self._rounds = problem, clock, MergingRounds()
        self.forms = problem.config.closed_form  # whether they have the closed form
        self.crispness = problem.config.crispness  # of a zoom-in
        self.power = AREA_POWER  # of the areas, where opacities are not matched
        self.seen = BaseWeights(problem, clock)
        self.weights: Tensor | None = None  # [N, P]: the blend weights of the base's splats, where they are measured
        self.matcher = Matcher(problem, clock, self.seen)
        self.learns = takes_steps(problem.config, problem.scale, problem.base_effects, [problem.target])  # whether steps follow

    @property
    def are_matched(self) -> bool:
        """Whether their opacities are matched, as far as there is time."""
        return self.forms and self.matcher.is_of_use and self.weights is not None

    def make(self, fraction: float = 1.0, coarsely: bool = False) -> SplatModel:
        """The base in closed form, after merging its splats (`reduced`)."""
        student, weights = self.reduced(fraction, coarsely)
        self.form(student, weights)
        return student

    def matched_further(self, formed: SplatModel, wanted: Wanted, copied: Callable[[], SplatModel]) -> SplatModel:
        """A candidate whose opacities are matched in further sweeps, to what is `wanted` of its splats.

        `copied`: makes a model of the same splats, whose scales and opacities may be others.
        """
        further, splats = copied(), formed.gaussians(self._problem.views[0]).detach()
        with self._problem.phase("closed form"):
            reshape(further, lambda _: (splats.scales, self.matcher.matched(splats, wanted, self.matcher.possible.further)), self._problem.views)
        return further

    def reduced(self, fraction: float, coarsely: bool = False) -> tuple[SplatModel, Tensor | None]:
        """The base after merging its splats down to a fraction of them, or to the settings' `most_splats`; and the blend weights of these."""
        problem, student, weights = self._problem, self._problem.base(), self.weights
        if fraction < 1 and weights is not None:
            with problem.phase("merging"):
                weights = self.merge(student, weights, fraction, coarsely)
        elif fraction < 1 and student.traits.thins:
            with problem.phase("thinning"):
                means = student.parameters()["means"].detach()
                cast(Thinned, student).thin(evenly_in_space(means, self.seen.pixel_size(means) / problem.scale, fraction))
        return student, weights

    def form(self, student: SplatModel, weights: Tensor | None) -> None:
        """Give the student's splats, which have these blend weights, the closed form."""
        if self.forms:
            with self._problem.phase("closed form"):
                views = self._problem.views
                seen = means_at(student, views[0]) if student.traits.moves and student.traits.rows == SPLATS else None
                reshape(student, lambda rest: self._closed_form(rest if seen is None else replace(rest, means=seen), weights), views)

    def merge(self, student: SplatModel, weights: Tensor, fraction: float, coarsely: bool) -> Tensor:
        """Merge the student's splats down to a fraction of them, or to `most_splats`; return the blend weights of the merged splats."""
        problem, merged_weights = self._problem, []

        def pixel_of(means: Tensor) -> Tensor:
            return self.seen.pixel_size(means) / problem.scale

        def merged(gaussians: Gaussians) -> Gaussians:
            most = problem.config.most_splats or (math.ceil(fraction * len(gaussians)) if coarsely else None)
            if most is None:
                splats, new_weights = merge_seen(gaussians, pixel_of(gaussians.means), weights, fraction, self.seen.shown, self._rounds)
            else:
                splats, new_weights = merge_down(gaussians, pixel_of, weights, most)
            merged_weights.append(new_weights)
            return splats

        rebuild(student, merged)
        return merged_weights[0]

    def _closed_form(self, gaussians: Gaussians, weights: Tensor | None) -> tuple[Tensor, Tensor]:
        """Scales [N, 3] and opacities [N] in closed form, with opacities that match the blend weights where these are known."""
        problem, sweeps = self._problem, self.matcher.sweeps_for(weights)
        pixel = self.seen.pixel_size(gaussians.means)
        formed_for = mean_pixel_size(gaussians.means, problem.closest_of, self.seen.count) if problem.scale > 1 else pixel
        power = 1.0 if sweeps else self.power
        least = LEAST_AXIS if self.learns and not self._clock.limited else 0.0
        settings = FormSettings(power, self.crispness, self.seen.count, formed_for, matched=power == 1, least_axis=least)
        scales, opacities = closed_form(gaussians, problem.views, problem.scale, problem.base_effects, problem.target, settings)
        if weights is None or not sweeps:
            return scales, opacities
        formed = replace(gaussians, scales=scales, opacities=opacities)
        return scales, self.matcher.matched(formed, self.seen.wanted(gaussians, weights), sweeps)
