"""The time that a run will spend on the field of a moving scene: evaluations become rarer as rates fall, so that the time so far does not tell it."""

from __future__ import annotations

import torch

from mipmap_plugin.adaptation.optimization.following import Following
from mipmap_plugin.adaptation.optimization.optimizer import decayed
from mipmap_plugin.adaptation.optimization.steering import warmed_up
from mipmap_plugin.config import AdaptConfig

# Splats wander: the tenth that moves farthest has come as far as the root of the sum of all squared rates, times about this (1.5 to 6).
SPEED = 2.5


class Evaluations:
    """Foretells the evaluations from how far splats have moved so far under the learning rates of the steps; at first from what is usual.

    A round lasts until splats have moved so far that the field has to be evaluated anew. A moment is evaluated when a view shows it for the first
    time in a round.
    """

    def __init__(self, follow: Following, config: AdaptConfig, checked: int = 0) -> None:
        """`checked`: the number of views that each check draws."""
        self._follow, self._config, self._checked, self._before = follow, config, checked, follow.seconds
        steps = range(config.steps if follow.moments else 0)  # other scenes have no evaluations, and steps may be millions
        factors = [warmed_up(step, config) * decayed(config, step / config.steps) for step in steps]
        self._factors = torch.tensor(factors, dtype=torch.float64)
        self._squares = 0.0  # px², the sum over all steps so far of their squared rates

    def spent(self) -> float:
        """Seconds of the evaluations since the run began."""
        return self._follow.seconds - self._before

    def seconds(self, step: int, ceiling: float, draws: int, checks: int) -> float:
        """Seconds that evaluations after `step` will take; called after each step.

        `draws`: the number of views that the steps left draw; `checks`: the number of checks left; `ceiling`: of the rates' factor (`Steering`).
        """
        if not self._follow.moments:
            return 0.0
        self._squares += (self._config.rates.means * min(float(self._factors[step - 1]), ceiling)) ** 2
        if step >= self._config.steps:
            return 0.0
        return self._follow.evaluation * self._count(step, ceiling, draws + checks * self._checked)

    def of_all_steps(self) -> float:
        """Seconds that the evaluations of a whole run of a moving scene take, before its first step."""
        return self._follow.evaluation * self._count(0, 1.0, self._config.steps * self._config.views_per_step)

    def _count(self, step: int, ceiling: float, draws: float) -> float:
        """How many evaluations so many draws after `step` need."""
        rates = self._config.rates.means * self._factors[step:].clamp(max=ceiling)  # px
        wandered = (self._squares + rates.square().cumsum(0)).sqrt()  # px after each step
        before, most = self._squares**0.5, self._follow.moments
        a_round = (before + self._follow.reach / SPEED) / (self._follow.rounds + 1)  # as if one had taken what is usual
        rounds = (self._follow.rounds % 1 + (wandered - before) / a_round).long()
        new = torch.full((int(rounds[-1]) + 1,), float(most), dtype=torch.float64)
        new[0] = self._follow.unknown
        views = rounds.bincount() * draws / len(rounds)
        return float((new * -torch.expm1(-views / most)).sum())
