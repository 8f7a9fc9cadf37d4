"""What the parts of a run have cost so far, and the time that is left.

Steps do not all take the same time: in the warm-up they use fewer views, and at first most views are new, so that their truth has to be made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.evaluations import Evaluations
from mipmap_plugin.adaptation.views import ViewSchedule
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.process import threads
from mipmap_plugin.process.clock import now
from mipmap_plugin.progress import Bar

Result = TypeVar("Result")


@dataclass
class Costs:
    """Seconds, by what they were spent on. Work in parallel counts as the time that passed; that of a GPU until it is done."""

    truths: dict[Camera, float] = field(default_factory=dict)  # of making the truth of each view
    checks: list[float] = field(default_factory=list)  # of each comparison with the validation views
    earlier: tuple[float, float] = (0.0, 0.0)  # of truths and of checks, in the processes that a run was interrupted in
    motion: Callable[[], float] = lambda: 0.0  # of evaluating the field of a moving scene, so far; not part of the others
    device: torch.device | None = None  # that does the work

    def truth(self, view: Camera, make: Callable[[Camera], Tensor]) -> Tensor:
        """Return the truth of a view; the first time, note how long it took."""
        if view in self.truths:
            return make(view)
        began = self._now()
        image = make(view)
        self.truths.setdefault(view, (self._now() - began) / threads.side_by_side_now())
        return image

    def prepare(self, views: Sequence[Camera], make: Callable[[Sequence[Camera]], object]) -> None:
        """Make the truths of `views`, which have none yet, together; note how long that took."""
        began = self._now()
        make(views)
        each = (self._now() - began) / len(views)
        for view in views:
            self.truths.setdefault(view, each)

    def check(self, validate: Callable[[], Result]) -> Result:
        """Return the result of a validation, and note how long it took."""
        began = self._now()
        result = validate()
        self.checks.append(self._now() - began)
        return result

    def sums(self) -> tuple[float, float]:
        """The seconds of all truths, and of all checks, of the whole run."""
        return self.earlier[0] + sum(self.truths.values()), self.earlier[1] + sum(self.checks)

    def seconds(self) -> float:
        """All that is noted."""
        return sum(self.sums())

    def _now(self) -> float:
        return now(self.device) - self.motion()


@dataclass(frozen=True)
class Forecast:
    """The time that a run will still take, from what its parts have cost so far."""

    schedule: ViewSchedule
    config: AdaptConfig
    checks_until: Callable[[int], int]  # the number of checks up to and after a step
    evaluations: Evaluations  # of the field of a moving scene
    first_step: int = 0  # steps that an earlier process has done
    history: list[tuple[int, float]] = field(default_factory=list)  # draws and seconds of the views alone, before each step of this process

    def left(self, step: int, seconds: float, costs: Costs, ceiling: float = 1.0) -> float:
        """Seconds left after `step`, of which everything since the first step has taken `seconds`; infinity before there is a step.

        `ceiling`: of the rates' factor (`Steering`).
        """
        first, done, last = (self.schedule.draws_before(number) for number in (self.first_step, step, self.config.steps))
        if done == first:
            return math.inf
        self.history.append((done, seconds - costs.seconds() - self.evaluations.spent()))
        # Since half of the steps: the first ones take longer than all others.
        draws, spent = self.history[len(self.history) // 2 - 1] if len(self.history) > 1 else (first, 0.0)
        a_view = (self.history[-1][1] - spent) / (done - draws)
        new_views = max(0, min(self.schedule.view_count, last) - len(costs.truths))
        checks = self.checks_until(self.config.steps) - self.checks_until(step)
        motion = self.evaluations.seconds(step, ceiling, last - done, checks)
        return (last - done) * a_view + new_views * _mean(costs.truths.values()) + checks * _mean(costs.checks) + motion


def _mean(seconds: Any) -> float:
    return sum(seconds) / len(seconds) if seconds else 0.0


class StepsBar(Bar):
    """A progress bar of steps that shows the time left by a forecast, where tqdm would take all steps as equally long."""

    seconds_left = math.inf

    @property
    def format_dict(self) -> dict[str, Any]:
        left = "?" if math.isinf(self.seconds_left) else self.format_interval(self.seconds_left)
        return {**super().format_dict, "left": left}


BAR = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{left}, {rate_fmt}{postfix}]"
