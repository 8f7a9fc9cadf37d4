"""The choice of the model that a run begins with: the base as it is, the closed form, or the closed form of merged splats."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.amount import takes_steps
from mipmap_plugin.adaptation.optimization.validation import Quality
from mipmap_plugin.adaptation.pixel_size import mean_pixel_size
from mipmap_plugin.adaptation.start.base_weights import BaseWeights
from mipmap_plugin.adaptation.start.blend_weights import Wanted
from mipmap_plugin.adaptation.start.clock import Clock, start_clock
from mipmap_plugin.adaptation.start.closed_form import AREA_POWER, LEAST_AXIS, FormSettings, closed_form, draws_alike
from mipmap_plugin.adaptation.start.matching import Matcher
from mipmap_plugin.adaptation.start.merging import MergingRounds, merge_down, merge_seen
from mipmap_plugin.adaptation.start.problem import StartProblem
from mipmap_plugin.adaptation.start.strength import POWERS, Bounds, Candidate, Merger, MergingCosts
from mipmap_plugin.adaptation.start.thinning import evenly_in_space, least_fraction
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SPLATS, SplatModel, Thinned, means_at
from mipmap_plugin.models.contract import rebuild, reshape

# Crispnesses also tried where a zoom-in below CRISPER_BELOW takes no steps: from there on the softest always looks best, shrunk, even of thin wires.
CRISPER, CRISPER_BELOW = (0.5, 1.0), 2.0

# The least dB of splats that are merged even where too few share a pixel: from 29 dB steps regained all that merging had cost, from 20 dB a third.
LEAST_DB = 25.0

# dB by which such a result may be worse than the base itself: steps regain 3 to 8 dB.
COARSE_COSTS = 3.0

# In a time budget that is too short for a search, a run begins with the strongest merging, which makes steps much faster: if the settings ask for at
# most FAR_FEWER of the splats, and no more than REACHED times as many are left. Lego and chair keep up to 1.3 times as many, and gain 0.6 to 5 dB by
# it; two captures and three other scenes keep 2.1 times as many and more, and the captures' starts would lose 0.7 to 2 dB.
FAR_FEWER, REACHED = 1 / 4, 1.5

# Where more than this part of the splats become too faint to be drawn, one sweep of matching, or none, and this power of areas are tried too.
# What is not drawn has no weight, so that matching raises it, until all of it together hides several times too much. Four objects gain 0 to 4 dB by
# it at x1/16, 1 to 8 at x1/32 and 5 to 11 at x1/64, two captures nothing.
FAINT, FEWER = 0.1, (((1,), AREA_POWER), ((), 1.0), ((), AREA_POWER))

# dB by which further sweeps may look worse: on other views than those that choose, eight starts of objects and captures were 0 to 0.5 dB better.
EVEN = 0.1

# The budget is long enough for a search if that is expected to end within this part of the start's time; whole runs need less of it.
SEARCH_PART = 1 / 4


def start_name(forms: bool, *, merged: bool = False, thinned: bool = False) -> str:
    """What a start is called in the report. `forms`: it has the closed form; `thinned`: rows were left out instead of merged."""
    splats = "a part of the base" if thinned else "merged splats" if merged else "the base"
    if not forms:
        return splats
    return f"the closed form of {splats}" if merged else "the closed form"


@torch.no_grad()
def best_start(problems: Sequence[StartProblem]) -> tuple[SplatModel, str, list[str]]:
    """The best start, what it is called in the report, and what is to be said of it. `problems`: one, or two, of which one begins with a conversion.

    At x1 a viewer's filter may be wider than the base's, which takes from thin splats what a zoom-in, where that filter is narrower, needs.
    In a time budget the second one is tried if there is time for another start like the first.
    """
    clock, found = start_clock(problems[0]), list[tuple[SplatModel, str, list[str]]]()
    for problem in problems:
        if not found or clock.allows("start"):
            with clock.timing("start"):
                search = StartSearch(problem, clock.rest())
                start, name = search.best()
            found.append((start, name if len(problems) == 1 or problem.coarse_base else f"{name} without the conversion", search.notes))
            del search  # which keeps memory
    return max(found, key=lambda each: problems[0].quality(each[0]).visible) if len(found) > 1 else found[0]


class StartSearch:
    """The candidates, and the choice among them by their PSNR on the steering views."""

    def __init__(self, problem: StartProblem, clock: Clock) -> None:
        self._problem, self._clock, self._rounds = problem, clock, MergingRounds()
        self._least, self._crispness = 0.0, problem.config.crispness  # the fraction of the rows that stay, of a zoom-in how crisp it is
        self._power = AREA_POWER  # of the areas, where opacities are not matched
        self._seen = BaseWeights(problem, clock)
        self._weights: Tensor | None = None  # [N, P]: the blend weights of the base's splats, once they are measured
        self._matcher = Matcher(problem, clock, self._seen)
        self.notes = self._seen.notes
        self._alike = draws_alike(problem.base_effects, problem.target)
        self._forms = problem.config.closed_form
        self._learns = takes_steps(problem.config, problem.scale, problem.base_effects, [problem.target])  # whether steps follow

    @torch.no_grad()
    def best(self) -> tuple[SplatModel, str]:
        """Return the model to begin with, which may share tensors with the base, and its name."""
        problem, config, base = self._problem, self._problem.config, self._problem.base()
        too_many = config.most_splats is not None and len(base.parameters()["means"]) > config.most_splats
        if not (config.closed_form or config.merge_to < 1 or too_many):
            return base, problem.name
        with problem.phase("blend weights"):
            merges = config.merge_to < 1 and not base.traits.thins
            self._weights = self._seen.measured(base) if self._matcher.is_of_use or merges or too_many else None
        if too_many:
            return self._with_most(), start_name(self._forms, merged=True)
        if (merged := self._merged_at_once()) is not None:
            return merged, start_name(self._forms, merged=True)
        with self._clock.timing("candidate"):
            formed = self._candidate()
        if config.merge_to == 1 and config.returns == "last":
            return formed, start_name(self._forms)
        before, (formed, after) = problem.quality(base), self._as_crisp_as_shown(formed)
        formed, after = self._matched_as_shown(formed, after)
        if self._alike and after.visible < before.visible:  # the filter itself is the better answer, for merged splats too
            self._forms, after = False, before
        bounds = Bounds(self._least_psnr(after), before.visible - problem.may_lose, after.psnr)
        self._least = least_fraction(base, problem.views, problem.scale) if base.traits.thins else 0.0
        fewer = config.merge_to < 1 and self._least < 1
        if fewer and (strongest := self._merger().strongest(bounds, self._coarse_bounds(bounds, before))):
            return strongest.made, start_name(self._forms, merged=True, thinned=base.traits.thins)
        return (formed, start_name(True)) if self._forms and after.visible >= before.visible else (base, problem.name)

    def _as_crisp_as_shown(self, formed: SplatModel) -> tuple[SplatModel, Quality]:
        """The closed form, or a crisper one where a small zoom-in takes no steps and looks better by that; and its quality."""
        problem, quality = self._problem, self._problem.quality(formed)
        still = self._forms and not self._learns and 1 < problem.scale < CRISPER_BELOW
        for crispness in CRISPER if still else ():
            if crispness > (before := self._crispness) and self._clock.allows("candidate"):
                self._crispness = crispness
                crisper = self._candidate()
                if (better := problem.quality(crisper)).visible <= quality.visible:
                    self._crispness = before
                    break
                formed, quality = crisper, better
        return formed, quality

    def _matched_as_shown(self, formed: SplatModel, quality: Quality) -> tuple[SplatModel, Quality]:
        """The closed form, or with opacities matched in fewer or more sweeps if no step follows and it looks better by that; and its quality."""
        if self._learns or not self._forms or not self._matcher.is_of_use or self._weights is None:
            return formed, quality
        less, better = self._matched_less(formed, quality)
        further, best = self._matched_further(formed, quality, self._seen.of_base, self._problem.base)
        if less is not formed and better.visible > best.visible:
            return less, better
        self._matcher.sweeps = None if further is formed else (*self._matcher.possible.usual, *self._matcher.possible.further)  # of merged splats too
        return further, best

    def _matched_less(self, formed: SplatModel, quality: Quality) -> tuple[SplatModel, Quality]:
        """The closed form, or with opacities matched in fewer sweeps where many become too faint to be drawn, if it looks better; and its quality."""
        drawn, still_drawn = (self._drawn(model) for model in (self._problem.base(), formed))
        fewer = FEWER[:-1] if self._alike else FEWER  # the last is no closed form of a filter that draws alike
        for sweeps, power in fewer if (drawn & ~still_drawn).float().mean() > FAINT else ():
            if self._clock.allows("candidate"):
                self._matcher.sweeps, self._power = sweeps, power
                less = self._candidate()
                if (better := self._problem.quality(less)).visible > quality.visible:
                    formed, quality = less, better
        self._matcher.sweeps, self._power = None, AREA_POWER
        return formed, quality

    def _drawn(self, model: SplatModel) -> Tensor:
        """[N] bool: which splats are opaque enough for the target to draw them."""
        return model.gaussians(self._problem.views[0]).opacities >= self._problem.target.settings.min_alpha

    def _matched_further(
        self, formed: SplatModel, quality: Quality, wanted: Wanted, copied: Callable[[], SplatModel]
    ) -> tuple[SplatModel, Quality]:
        """The closed form, or with opacities matched in further sweeps if it looks no worse by that; and its quality.

        `copied`: makes a model of the same splats, whose scales and opacities may be others.
        """
        problem, sweeps = self._problem, self._matcher.possible.further
        if not self._matcher.allows(wanted.weights, sweeps):
            return formed, quality
        further, splats = copied(), formed.gaussians(problem.views[0]).detach()
        with problem.phase("closed form"):
            reshape(further, lambda _: (splats.scales, self._matcher.matched(splats, wanted, sweeps)), problem.views)
        better = problem.quality(further)
        return (further, better) if better.visible > quality.visible - EVEN else (formed, quality)

    def _with_most(self) -> SplatModel:
        """The closed form of `most_splats` merged splats."""
        student, weights = self._reduced(0.0)
        merged = student.gaussians(self._problem.views[0]).detach()
        self._form(student, weights)
        if self._learns or not self._forms or not self._matcher.is_of_use or weights is None:
            return student
        return self._matched_further(student, self._problem.quality(student), self._seen.wanted(merged, weights), student.copy)[0]

    def _merged_at_once(self) -> SplatModel | None:
        """The strongest merging, where a time budget is too short for a search and this is no worse than the base; else None."""
        problem, student, fraction = self._problem, self._problem.base(), self._fraction(1)
        if not self._clock.limited or self._weights is None or student.traits.thins or problem.coarse_base is not None:
            return None
        if fraction > FAR_FEWER or not problem.config.steps:
            return None
        with problem.phase("merging"):
            new_weights = self._merge(student, self._weights, fraction, coarsely=False)
        left = len(new_weights) / len(self._weights)
        if left > REACHED * fraction:
            return None
        least = problem.quality(problem.base()).visible - problem.may_lose
        with self._clock.timing("form", left):
            self._form(student, new_weights)
            quality = problem.quality(student)
        searches = self._clock.allows("form", 1 + self._fraction(POWERS[-1]), SEARCH_PART)
        return None if searches or quality.visible < least else student

    def _least_psnr(self, formed: Quality) -> float:
        """What merging has to leave of the PSNR of the closed form: of a level that no step betters, half of what it gains on the base."""
        problem, least = self._problem, formed.psnr - self._problem.config.merging_costs
        if problem.coarse_base is None or problem.config.steps:
            return least
        return max(least, (formed.psnr + problem.quality(problem.coarse_base()).psnr) / 2)

    def _merger(self) -> Merger[SplatModel]:
        problem, count = self._problem, len(self._problem.base().parameters()["means"])

        def merge(power: float, coarsely: bool) -> Candidate[SplatModel] | None:
            fraction = self._fraction(power)
            if not self._clock.allows("candidate", fraction):
                return None
            with self._clock.timing("candidate", fraction):
                candidate = self._candidate(fraction, coarsely)
                return Candidate(candidate, problem.quality(candidate), len(candidate.parameters()["means"]))

        costs = MergingCosts.of(problem.config, problem.base_effects, problem.target)
        return Merger(merge, lambda power: math.ceil(self._fraction(power) * count), costs)

    def _fraction(self, power: float) -> float:
        """The fraction of the splats that a power of `merge_to` leaves."""
        return max(self._least, math.pow(self._problem.config.merge_to, power))

    def _coarse_bounds(self, bounds: Bounds, finer: Quality) -> Bounds | None:
        """The bounds of a coarsely merged candidate; None where there are none of these. `finer`: the quality of the finer level."""
        if (coarse_base := self._problem.coarse_base) is None:
            return None
        base = self._problem.quality(coarse_base())
        return bounds._replace(psnr=max(bounds.psnr, LEAST_DB, finer.psnr - self._problem.may_lose, base.psnr - COARSE_COSTS))

    def _candidate(self, fraction: float = 1.0, coarsely: bool = False) -> SplatModel:
        """The base in closed form, after merging its splats (`_reduced`)."""
        student, weights = self._reduced(fraction, coarsely)
        self._form(student, weights)
        return student

    def _reduced(self, fraction: float, coarsely: bool = False) -> tuple[SplatModel, Tensor | None]:
        """The base after merging its splats down to a fraction of them, or to the settings' `most_splats`; and the blend weights of these."""
        problem, student, weights = self._problem, self._problem.base(), self._weights
        if fraction < 1 and weights is not None:
            with problem.phase("merging"):
                weights = self._merge(student, weights, fraction, coarsely)
        elif fraction < 1 and student.traits.thins:
            with problem.phase("thinning"):
                means = student.parameters()["means"].detach()
                cast(Thinned, student).thin(evenly_in_space(means, self._seen.pixel_size(means) / problem.scale, fraction))
        return student, weights

    def _form(self, student: SplatModel, weights: Tensor | None) -> None:
        """Give the student's splats, which have these blend weights, the closed form."""
        if self._forms:
            with self._problem.phase("closed form"):
                views = self._problem.views
                seen = means_at(student, views[0]) if student.traits.moves and student.traits.rows == SPLATS else None
                reshape(student, lambda rest: self._closed_form(rest if seen is None else replace(rest, means=seen), weights), views)

    def _merge(self, student: SplatModel, weights: Tensor, fraction: float, coarsely: bool) -> Tensor:
        """Merge the student's splats down to a fraction of them, or to `most_splats`; return the blend weights of the merged splats."""
        problem, merged_weights = self._problem, []

        def pixel_of(means: Tensor) -> Tensor:
            return self._seen.pixel_size(means) / problem.scale

        def merged(gaussians: Gaussians) -> Gaussians:
            most = problem.config.most_splats or (math.ceil(fraction * len(gaussians)) if coarsely else None)
            if most is None:
                splats, new_weights = merge_seen(gaussians, pixel_of(gaussians.means), weights, fraction, self._seen.shown, self._rounds)
            else:
                splats, new_weights = merge_down(gaussians, pixel_of, weights, most)
            merged_weights.append(new_weights)
            return splats

        rebuild(student, merged)
        return merged_weights[0]

    def _closed_form(self, gaussians: Gaussians, weights: Tensor | None) -> tuple[Tensor, Tensor]:
        """Scales [N, 3] and opacities [N] in closed form, with opacities that match the blend weights where these are known."""
        problem, sweeps = self._problem, self._matcher.sweeps_for(weights)
        pixel = self._seen.pixel_size(gaussians.means)
        formed_for = mean_pixel_size(gaussians.means, problem.closest_of, self._seen.count) if problem.scale > 1 else pixel
        power = 1.0 if sweeps else self._power
        least = LEAST_AXIS if self._learns and not self._clock.limited else 0.0
        settings = FormSettings(power, self._crispness, self._seen.count, formed_for, matched=power == 1, least_axis=least)
        scales, opacities = closed_form(gaussians, problem.views, problem.scale, problem.base_effects, problem.target, settings)
        if weights is None or not sweeps:
            return scales, opacities
        formed = replace(gaussians, scales=scales, opacities=opacities)
        return scales, self._matcher.matched(formed, self._seen.wanted(gaussians, weights), sweeps)
