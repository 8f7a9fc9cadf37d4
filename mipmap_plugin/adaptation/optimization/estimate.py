"""The time that a run has left, and the progress bar that shows it.

Steps do not all take the same time: in the warm-up they use fewer views, and at first most views are new, so that their truth has to be made.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

from mipmap_plugin.adaptation.optimization.checks import checks_until
from mipmap_plugin.adaptation.optimization.costs import Costs
from mipmap_plugin.adaptation.optimization.evaluations import Evaluations
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.views.schedule import ViewSchedule
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import plural
from mipmap_plugin.progress import Bar

BAR = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{left}, {rate_fmt}{postfix}]"


@dataclass(frozen=True)
class Forecast:
    """The time that a run will still take, from what its parts have cost so far."""

    schedule: ViewSchedule
    config: AdaptConfig
    evaluations: Evaluations  # of the field of a moving scene
    first_step: int = 0  # steps that an earlier process has done
    history: list[tuple[int, float]] = field(default_factory=list)  # draws and seconds of the views alone, before each step of this process

    def left(self, step: int, seconds: float, costs: Costs, ceiling: float) -> float:
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
        checks = checks_until(self.config, self.config.steps) - checks_until(self.config, step)
        motion = self.evaluations.seconds(step, ceiling, last - done, checks)
        return (last - done) * a_view + new_views * _mean(costs.truths.values()) + checks * _mean(costs.checks) + motion


def _mean(seconds: Collection[float]) -> float:
    return sum(seconds) / len(seconds) if seconds else 0.0


class StepsBar(Bar):
    """A progress bar of steps that shows the time left by a forecast, where tqdm would take all steps as equally long."""

    forecast: Forecast
    began: float  # seconds of the run, but for those in its costs, as the bar began
    seconds_left = math.inf

    @classmethod
    def of(cls, run: Run, task: Task, config: AdaptConfig, order: ViewSchedule) -> StepsBar:
        """The bar of a run that begins or goes on."""
        bar = cls(total=config.steps, initial=run.step, desc=f"adapting {task.part or f'x{task.scale:g}'}", unit="step", bar_format=BAR)
        bar.forecast = Forecast(order, config, Evaluations(task.follow, config, len(task.validation.steering)), run.step)
        bar.began = run.watch.seconds - run.costs.seconds()
        return bar

    def show(self, run: Run, task: Task, config: AdaptConfig) -> None:
        """Show that a step is taken, the time left and, after a check, how good the run is."""
        left = self.forecast.left(run.step, run.watch.seconds - self.began, run.costs, run.steering.ceiling)
        self.seconds_left = min(left, run.budget_left(config))
        self.update()
        if run.curve[-1].step == run.step:
            quality = f"{run.curve[-1].validation_db:.2f} dB, " if task.validation.steering else ""
            self.set_postfix_str(f"{quality}{plural(run.curve[-1].gaussians, 'splat')}")

    @property
    def format_dict(self) -> dict[str, Any]:
        left = "?" if math.isinf(self.seconds_left) else self.format_interval(self.seconds_left)
        return {**super().format_dict, "left": left}
