"""A run that fits a time budget: steps, views and checks in the proportions of a whole run, whatever the machine and the scene.

Without it a short run spends its time on the truths of views that it hardly uses, and on a warm-up that is meant for ten times as many steps.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from mipmap_plugin.adaptation.curve import Stopwatch
from mipmap_plugin.adaptation.optimization.ending import End
from mipmap_plugin.adaptation.optimization.evaluations import Evaluations
from mipmap_plugin.adaptation.optimization.following import Following
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.target.pseudo_truth import resolution
from mipmap_plugin.adaptation.views.for_validation import WINDOW
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import plural
from mipmap_plugin.models.base import SplatModel

# A step takes so many times as long as its images, drawn one by one: they are drawn together, and then differentiated and moved.
STEP_OVER_IMAGE = 2.2

# A truth takes so many times as long as its pixels in an image of the new scale: large ones wait for memory, and are made smaller.
TRUTH_OVER_IMAGE = 2.5

# A short run uses each view so many times: a truth costs about as much as a view's part of a few steps. With 7, chair loses 0.7 dB in six seconds.
USES = 4

# Steps are planned for this part more than what the budget is thought to allow: rates fall by the clock too, so that a run of too many steps
# ends well, but one of too few leaves time unused.
SPARE = 1.25

# Measured so many times, of which the shortest counts, unless the first takes longer than this.
REPEATS, LONG_S = 2, 0.5

# Different states of the splats of which the best is chosen after the steps: the start, the best and the last one.
STATES = 3


@dataclass(frozen=True)
class Pace:
    """Seconds."""

    a_view: float  # of a step, for each of its views
    a_truth: float
    a_check: float
    a_choice: float = 0.0  # among the states, after the steps

    @classmethod
    @torch.no_grad()
    def of(cls, student: SplatModel, task: Task, size: float = 1.0, left: float = math.inf) -> Pace:
        """The pace of a run over `student` that has so many seconds left. The truths that are made for it are used later.

        `size`: the fraction of the base's size at which these are drawn. No image and no truth is made if more time than is left is expected of
        it, by its pixels: of a large image its middle is measured. Validation that uses no more than the middle is measured as it is done.
        """
        views, validation = task.views[:REPEATS], task.validation
        cameras = [view.zoomed(task.scale) for view in views]
        device = student.parameters()["means"].device

        def shortest(cameras: Sequence[Camera]) -> float:
            return _shortest(lambda camera: task.renders[0](student.gaussians(camera), camera), cameras, device)

        def validates(view: Camera) -> None:
            validation.viewer_psnrs(student, [view])

        image, middle = 0.0, cameras[0].window(WINDOW, WINDOW)
        if middle.size != cameras[0].size:
            image = shortest([middle]) * math.prod(cameras[0].size) / math.prod(middle.size)
        image = image if image > left else shortest(cameras)
        truth = TRUTH_OVER_IMAGE * image * (size / task.scale) ** 2
        truth = truth if truth > left else _shortest(task.truth, views, device)
        moments = {view.time for view in validation.choosing} if task.follow.moments else ()
        look = first = image * len(validation.renders)
        if any(view.zoomed(task.scale).size != cameras[0].size for view in validation.choosing[:1]):
            look = _shortest(validates, validation.steering[:REPEATS], device)
            first = _seconds(validates, validation.choosing[0], device)  # with its truth
        choice = len(validation.choosing) * (first + (STATES - 1) * look) + STATES * len(moments) * task.follow.evaluation
        return cls(STEP_OVER_IMAGE * image, truth, look * len(validation.steering), choice)

    def a_step(self, config: AdaptConfig) -> float:
        """With its part of the truths and the checks."""
        return config.views_per_step * (self.a_view + self.a_truth / USES) + self.a_check / config.check_every

    def steps(self, config: AdaptConfig, seconds: float, follow: Following) -> int:
        """The number of steps that take so many seconds, with the truths, the checks and the evaluations of a field that they need; at most all."""

        def needed(steps: int) -> float:
            return steps * self.a_step(config) + Evaluations(follow, config.model_copy(update={"steps": steps})).of_all_steps()

        most = max(1, min(most_of(config), int(SPARE * seconds / self.a_step(config))))
        return max(1, bisect_right(range(1, most + 1), SPARE * seconds, key=needed)) if follow.moments else most


def for_upsampling(config: AdaptConfig, spent: float, resume: Path | None) -> float:
    """Seconds that a network may take for a run's views: half of what a time budget has left after so many seconds, the rest being for steps.

    Of the whole budget where the run may go on from a state in `resume`, which has its own seconds: these are spent on a start that it has already.
    """
    goes_on = resume is not None and resume.exists()
    return math.inf if config.time_budget_s is None else (config.time_budget_s - (0.0 if goes_on else spent)) / 2


def most_of(config: AdaptConfig) -> int:
    """The number of steps in a time budget that has room for them."""
    return max(config.steps, config.most_steps or 0)


def within_budget(run: Run, task: Task, config: AdaptConfig) -> tuple[Task, AdaptConfig]:
    """The task and the settings with as many further steps as the time budget allows, and as many views as these use.

    Only of runs that introduce their views one after the other; those of other recipes are short, or take all views from the start. A run
    that goes on has its plan already.
    """
    if config.time_budget_s is None or not task.views or run.watch.seconds >= config.time_budget_s:
        return task, config
    if not run.planned:
        with run.watch:
            pace = Pace.of(run.student, task, resolution(config, task.scale), config.time_budget_s - run.watch.seconds)
        run.reserved, run.planned = pace.a_choice, config.steps
        if run.seconds + pace.a_view + pace.a_truth > config.time_budget_s:  # not even a step of one view
            run.reserved += pace.a_view + pace.a_truth
        if config.gathering:
            run.planned = min(most_of(config), pace.steps(config, max(0.0, config.time_budget_s - run.seconds), task.follow))
    if not config.gathering:
        return task, config
    views = max(config.views_per_step, math.ceil(run.planned * config.views_per_step / USES))
    return replace(task, views=evenly(task.views, views)), config.model_copy(update={"steps": run.planned})


def plan_note(run: Run, config: AdaptConfig) -> str:
    """Which steps were planned for a time budget, in brackets; empty if they are those of the settings, or if something else ended the run."""
    planned = run.step >= run.planned or run.ended_by is End.TIME
    if not run.step or not planned or run.planned in (0, config.steps):
        return ""
    taken = "" if run.step >= run.planned else f"after {run.step} of {plural(run.planned, 'step')}, "
    return f" ({taken}planned for the time budget in place of {config.steps})"


def no_steps_notes(run: Run, config: AdaptConfig, share: float) -> list[str]:
    """That a time budget, of which the run has a share, left no time for steps, and which one would; empty if it did."""
    if config.time_budget_s is None or run.step or run.seconds < config.time_budget_s:
        return []
    least = math.ceil(2 * run.seconds / share)  # the start takes half of a share at most
    return [f"the time budget of {config.time_budget_s / share:g} s left no time for steps after the start; give {least} s or more to have some"]


def _shortest(function: Callable[[Camera], object], cameras: Sequence[Camera], device: torch.device) -> float:
    """The least of the seconds that each camera takes; of long ones those of the first."""
    first = _seconds(function, cameras[0], device)
    return first if first > LONG_S else min([first, *(_seconds(function, camera, device) for camera in cameras[1:])])


def _seconds(function: Callable[[Camera], object], camera: Camera, device: torch.device) -> float:
    with Stopwatch(device) as watch:
        function(camera)
    return watch.seconds
