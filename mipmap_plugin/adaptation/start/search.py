"""The choice of the model that a run begins with: the base as it is, the closed form, or the closed form of merged splats."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.validation import Quality
from mipmap_plugin.adaptation.start.blend_weights import Wanted
from mipmap_plugin.adaptation.start.candidates import Candidates
from mipmap_plugin.adaptation.start.clock import Clock, start_clock
from mipmap_plugin.adaptation.start.closed_form import AREA_POWER, draws_alike
from mipmap_plugin.adaptation.start.problem import StartProblem
from mipmap_plugin.adaptation.start.strength import POWERS, Bounds, Candidate, Merger, MergingCosts
from mipmap_plugin.adaptation.start.thinning import least_fraction
from mipmap_plugin.models.base import SplatModel

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

# What fewer splats are called: merged ones, or those that are left where rows cannot be merged.
MERGED_SPLATS, PART_OF_BASE = "merged splats", "a part of the base"


def start_name(forms: bool, fewer: str = "") -> str:
    """What a start is called in the report. `forms`: it has the closed form; `fewer`: what its splats are called if they are fewer."""
    if forms:
        return f"the closed form of {fewer}" if fewer else "the closed form"
    return fewer or "the base"


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
    """The choice among candidates by their PSNR on the steering views."""

    def __init__(self, problem: StartProblem, clock: Clock) -> None:
        self._problem, self._clock = problem, clock
        self._candidates = Candidates(problem, clock)
        self._merge_to = problem.config.merge_to if problem.config.most_splats is None else 1.0  # a number of splats takes its place
        self._least = 0.0  # the fraction of the rows that stay
        self._alike = draws_alike(problem.base_effects, problem.target)

    @property
    def notes(self) -> list[str]:
        """What is to be said of the start."""
        return self._candidates.seen.notes

    @torch.no_grad()
    def best(self) -> tuple[SplatModel, str]:
        """Return the model to begin with, which may share tensors with the base, and its name."""
        problem, config, base, candidates = self._problem, self._problem.config, self._problem.base(), self._candidates
        too_many = config.most_splats is not None and len(base.parameters()["means"]) > config.most_splats
        if not (config.closed_form or self._merge_to < 1 or too_many):
            return base, problem.name
        with problem.phase("blend weights"):
            merges = self._merge_to < 1 and not base.traits.thins
            candidates.weights = candidates.seen.measured(base) if candidates.matcher.is_of_use or merges or too_many else None
        if too_many:
            return self._with_most(), start_name(candidates.forms, MERGED_SPLATS)
        if (merged := self._merged_at_once()) is not None:
            return merged, start_name(candidates.forms, MERGED_SPLATS)
        with self._clock.timing("candidate"):
            formed = candidates.make()
        if self._merge_to == 1 and config.returns == "last":
            return formed, start_name(candidates.forms)
        before, (formed, after) = problem.quality(base), self._as_crisp_as_shown(formed)
        formed, after = self._matched_as_shown(formed, after)
        if self._alike and after.visible < before.visible:  # the filter itself is the better answer, for merged splats too
            candidates.forms, after = False, before
        bounds = Bounds(self._least_psnr(after), before.visible - problem.may_lose, after.psnr)
        self._least = least_fraction(base, problem.views, problem.scale) if base.traits.thins else 0.0
        fewer = self._merge_to < 1 and self._least < 1
        if fewer and (strongest := self._merger().strongest(bounds, self._coarse_bounds(bounds, before))):
            return strongest.made, start_name(candidates.forms, PART_OF_BASE if base.traits.thins else MERGED_SPLATS)
        return (formed, start_name(True)) if candidates.forms and after.visible >= before.visible else (base, problem.name)

    def _as_crisp_as_shown(self, formed: SplatModel) -> tuple[SplatModel, Quality]:
        """The closed form, or a crisper one where a small zoom-in takes no steps and looks better by that; and its quality."""
        problem, candidates, quality = self._problem, self._candidates, self._problem.quality(formed)
        still = candidates.forms and not candidates.learns and 1 < problem.scale < CRISPER_BELOW
        for crispness in CRISPER if still else ():
            if crispness > (before := candidates.crispness) and self._clock.allows("candidate"):
                candidates.crispness = crispness
                crisper = candidates.make()
                if (better := problem.quality(crisper)).visible <= quality.visible:
                    candidates.crispness = before
                    break
                formed, quality = crisper, better
        return formed, quality

    def _matched_as_shown(self, formed: SplatModel, quality: Quality) -> tuple[SplatModel, Quality]:
        """The closed form, or with opacities matched in fewer or more sweeps if no step follows and it looks better by that; and its quality."""
        if self._candidates.learns or not self._candidates.are_matched:
            return formed, quality
        less, better = self._matched_less(formed, quality)
        further, best = self._matched_further(formed, quality, self._candidates.seen.of_base, self._problem.base)
        if less is not formed and better.visible > best.visible:
            return less, better
        matcher = self._candidates.matcher
        matcher.sweeps = None if further is formed else (*matcher.possible.usual, *matcher.possible.further)  # of merged splats too
        return further, best

    def _matched_less(self, formed: SplatModel, quality: Quality) -> tuple[SplatModel, Quality]:
        """The closed form, or with opacities matched in fewer sweeps where many become too faint to be drawn, if it looks better; and its quality."""
        candidates = self._candidates
        drawn, still_drawn = (self._drawn(model) for model in (self._problem.base(), formed))
        fewer = FEWER[:-1] if self._alike else FEWER  # the last is no closed form of a filter that draws alike
        for sweeps, power in fewer if (drawn & ~still_drawn).float().mean() > FAINT else ():
            if self._clock.allows("candidate"):
                candidates.matcher.sweeps, candidates.power = sweeps, power
                less = candidates.make()
                if (better := self._problem.quality(less)).visible > quality.visible:
                    formed, quality = less, better
        candidates.matcher.sweeps, candidates.power = None, AREA_POWER
        return formed, quality

    def _drawn(self, model: SplatModel) -> Tensor:
        """[N] bool: which splats are opaque enough for the target to draw them."""
        return model.gaussians(self._problem.views[0]).opacities >= self._problem.target.settings.min_alpha

    def _matched_further(
        self, formed: SplatModel, quality: Quality, wanted: Wanted, copied: Callable[[], SplatModel]
    ) -> tuple[SplatModel, Quality]:
        """The closed form, or with opacities matched in further sweeps if it looks no worse by that; and its quality.

        `wanted`, `copied`: as of `Candidates.matched_further`.
        """
        if not self._candidates.matcher.allows(wanted.weights, self._candidates.matcher.possible.further):
            return formed, quality
        further = self._candidates.matched_further(formed, wanted, copied)
        better = self._problem.quality(further)
        return (further, better) if better.visible > quality.visible - EVEN else (formed, quality)

    def _with_most(self) -> SplatModel:
        """The closed form of `most_splats` merged splats."""
        student, weights = self._candidates.reduced(0.0)
        merged = student.gaussians(self._problem.views[0]).detach()
        self._candidates.form(student, weights)
        if self._candidates.learns or not self._candidates.are_matched or weights is None:
            return student
        return self._matched_further(student, self._problem.quality(student), self._candidates.seen.wanted(merged, weights), student.copy)[0]

    def _merged_at_once(self) -> SplatModel | None:
        """The strongest merging, where a time budget is too short for a search and this is no worse than the base; else None."""
        problem, student, fraction, weights = self._problem, self._problem.base(), self._fraction(1), self._candidates.weights
        if not self._clock.limited or weights is None or student.traits.thins or problem.coarse_base is not None:
            return None
        if fraction > FAR_FEWER or not problem.config.steps:
            return None
        with problem.phase("merging"):
            new_weights = self._candidates.merge(student, weights, fraction, coarsely=False)
        left = len(new_weights) / len(weights)
        if left > REACHED * fraction:
            return None
        least = problem.quality(problem.base()).visible - problem.may_lose
        with self._clock.timing("form", left):
            self._candidates.form(student, new_weights)
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
                candidate = self._candidates.make(fraction, coarsely)
                return Candidate(candidate, problem.quality(candidate), len(candidate.parameters()["means"]))

        costs = MergingCosts.of(problem.config, problem.base_effects, problem.target)
        return Merger(merge, lambda power: math.ceil(self._fraction(power) * count), costs)

    def _fraction(self, power: float) -> float:
        """The fraction of the splats that a power of `merge_to` leaves."""
        return max(self._least, math.pow(self._merge_to, power))

    def _coarse_bounds(self, bounds: Bounds, finer: Quality) -> Bounds | None:
        """The bounds of a coarsely merged candidate; None where there are none of these. `finer`: the quality of the finer level."""
        if (coarse_base := self._problem.coarse_base) is None:
            return None
        base = self._problem.quality(coarse_base())
        return bounds._replace(psnr=max(bounds.psnr, LEAST_DB, finer.psnr - self._problem.may_lose, base.psnr - COARSE_COSTS))
