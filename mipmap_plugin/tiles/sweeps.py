"""A run in sweeps: in each, every tile makes some of the steps in front of what the other tiles looked like when the sweep began."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from mipmap_plugin.adaptation.views.schedule import ViewSchedule
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig

# Sweeps after the warm-up, and the fewest steps of one. Each draws all its views once more, and gains little: less than two seeds differ by.
SWEEPS, LEAST_STEPS = 2, 10

# Checks of the whole scene in the warm-up, in which the rates rise until they do harm, and in every other sweep.
CHECKS_IN_WARM_UP, CHECKS = 6, 2


@dataclass(frozen=True)
class Sweep:
    """Some steps of a run."""

    number: int  # of all that are made
    first: int  # steps before it
    checks: tuple[int, ...]  # the steps after which the scene is checked; with the last of them, the sweep ends
    planned: int  # which of a run's sweeps it is
    halos: int  # the number of the sweep whose pictures it is drawn with: its own, unless it repeats a part of another
    repeats: int = 0  # how often that one was repeated, this time included

    @property
    def end(self) -> int:
        """The step with which it ends."""
        return self.checks[-1]


def sweeps(config: AdaptConfig) -> list[Sweep]:
    """The sweeps of a run, if nothing does harm; none without steps."""
    warm_up, ends = min(config.warm_up_steps, config.steps), [0]
    if warm_up:
        ends.append(warm_up)
    count = max(1, min(SWEEPS, (config.steps - warm_up) // LEAST_STEPS))
    ends += [warm_up + (config.steps - warm_up) * (number + 1) // count for number in range(count) if config.steps > warm_up]
    found = []
    for number, (first, end) in enumerate(pairwise(ends)):
        checks = min(end - first, CHECKS_IN_WARM_UP if end <= warm_up else CHECKS)
        found.append(Sweep(number, first, tuple(first + (end - first) * (check + 1) // checks for check in range(checks)), number, number))
    return found


def views_of(views: Sequence[Camera], config: AdaptConfig, first: int, end: int) -> list[Camera]:
    """Those of `views` that the steps from `first` to `end` use, in the order of `views`; all where the time decides about it."""
    if config.time_budget_s is not None and end > first:
        return list(views)
    schedule = ViewSchedule(views, config)
    used = {view for step in range(first, end) for view in schedule(step, step / config.steps)}
    return [view for view in views if view in used]
