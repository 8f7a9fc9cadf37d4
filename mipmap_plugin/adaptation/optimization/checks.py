"""The checks of a run: when they are due, and what is kept or undone by them."""

from __future__ import annotations

import math

from mipmap_plugin.adaptation.curve import CurvePoint, decibel
from mipmap_plugin.adaptation.optimization.density import ScreenGradients
from mipmap_plugin.adaptation.optimization.optimizer import restore_snapshot
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.config import AdaptConfig

# Number of checks during the warm-up, while the rates rise.
CHECKS_IN_WARM_UP = 10

# Number of checks of a short run, at least STEPS_BETWEEN steps apart, because a check takes as long as a step.
CHECKS, STEPS_BETWEEN = 6, 5


def is_checked(step: int, config: AdaptConfig) -> bool:
    """Whether the run is checked after this step: more often during the warm-up, and if the run is short."""
    return step % _steps_between(config, warming_up=step < config.warm_up_steps) == 0 or step in (config.warm_up_steps, config.steps)


def checks_until(config: AdaptConfig, step: int) -> int:
    """The number of checks up to and after this step, by arithmetic: a run that a budget ends may be given millions of steps."""
    warm_up, last = config.warm_up_steps, config.steps
    early, late = (_steps_between(config, warming_up=warming_up) for warming_up in (True, False))
    before = max(0, warm_up - 1)  # the last step of the warm-up that is checked as such
    count = min(step, before) // early
    if step >= warm_up:
        count += step // late - before // late + (warm_up % late > 0)
    return count + (step >= last != warm_up and last % late > 0)


def _steps_between(config: AdaptConfig, *, warming_up: bool) -> int:
    every = math.ceil(config.warm_up_steps / CHECKS_IN_WARM_UP) if warming_up else max(STEPS_BETWEEN, config.steps // CHECKS)
    return max(1, min(every, config.check_every))


def check(run: Run, task: Task, config: AdaptConfig) -> None:
    """Measure the run on validation views: keep its state or undo the last steps, and append a point to the curve."""
    steering, steps = run.steering, run.step - run.curve[-1].step
    quality = run.costs.check(lambda: task.validation.quality(run.student))
    growing = run.trial is not None and run.trial.before is not None  # a growth gets some steps before it is assessed
    factor, rising = steering.rate_factor(run.step, config), steering.is_rising(run.step, config)
    harmful = config.returns == "best" and not growing and steering.is_harmful(quality.visible, rising=rising)
    if harmful:
        steering.reduce_rates(factor, rising=rising)
        run.rows_changed |= len(steering.best.rows["means"]) != len(run.student.parameters()["means"])
        restore_snapshot(run.student, run.optimizer, steering.best)
        run.gradients = None if run.gradients is None else ScreenGradients.of(run.student.parameters()["means"], config)
    else:
        steering.update_best(quality.visible, run.step, run.student, run.rows_changed, factor)
    if task.dares and steering.is_stuck(run.progress(config), config):
        steering.dare()
    mean = float(run.square_error) / max(1, steps)  # this waits for a GPU, so that the clock counts its work
    best_db = next((point.validation_db for point in reversed(run.curve) if point.step == steering.best_step), quality.psnr)
    point = CurvePoint(
        step=run.step, seconds=run.watch.read(), psnr_db=decibel(mean) if steps else None,
        validation_db=best_db if harmful else quality.psnr, gaussians=task.count(run.student), taken_back=harmful,
    )  # fmt: skip
    run.curve.append(point)
    run.square_error = 0.0


def check_again(run: Run, task: Task) -> None:
    """Measure the run anew after a check of a growth that is undone since."""
    psnr = run.costs.check(lambda: task.validation.quality(run.student)).psnr
    run.curve[-1] = run.curve[-1].model_copy(update={"validation_db": psnr, "gaussians": task.count(run.student)})
