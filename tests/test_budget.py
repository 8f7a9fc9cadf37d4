"""A run with a time budget has as many steps and views as fit into it."""

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.curve import Stopwatch
from mipmap_plugin.adaptation.optimization import budget
from mipmap_plugin.adaptation.optimization.budget import SPARE, USES, Pace, within_budget
from mipmap_plugin.adaptation.optimization.optimizer import make_optimizer
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.optimization.validation import Steering, no_validation
from mipmap_plugin.recipes import recipe

PACE = Pace(a_view=0.01, a_truth=0.02, a_check=0.05)


@pytest.fixture(autouse=True)
def known_pace(monkeypatch):
    monkeypatch.setattr(Pace, "of", classmethod(lambda cls, student, task: PACE))


def a_task(views: int) -> Task:
    truth, render = (lambda view: torch.zeros(*view.size, 3)), (lambda splats, camera: torch.zeros(*camera.size, 3))
    return Task(tiny.cameras(views), 1 / 4, truth, render, False, no_validation(truth, render))


def a_run(seconds: float, step: int = 0) -> Run:
    student = tiny.model(5).copy()
    optimizer = make_optimizer(student, recipe("default", 1 / 4), 0.1)
    return Run(student, optimizer, Stopwatch(seconds=seconds), None, Steering.begin(student, 0.0), step=step)


def test_steps_fill_the_budget_with_their_truths_and_checks():
    config = recipe("default", 1 / 4)
    a_step = config.views_per_step * (0.01 + 0.02 / USES) + 0.05 / config.check_every
    assert PACE.steps(config, 2.0) == int(SPARE * 2.0 / a_step)
    assert PACE.steps(config, 0.0) == 1


def test_a_short_run_has_fewer_views():
    task, config = a_task(40), recipe("default", 1 / 4, time_budget_s=3.0)
    fewer, shorter = within_budget(a_run(2.5), task, config)
    assert shorter.steps == PACE.steps(config, 0.5)
    assert len(fewer.views) == -(-config.views_per_step * shorter.steps // USES) < 40 and set(fewer.views) < set(task.views)
    assert shorter.warm_up_steps < config.warm_up_steps


def test_a_run_that_goes_on_has_further_steps():
    config = recipe("default", 1 / 4, time_budget_s=3.0)
    assert within_budget(a_run(2.5, step=100), a_task(4), config)[1].steps == 100 + PACE.steps(config, 0.5)


NO_CHANGE = [(dict(), 0.0), (dict(time_budget_s=1e6), 0.0), (dict(time_budget_s=3.0), 4.0), (dict(time_budget_s=3.0, gathering=0.0), 0.0)]


@pytest.mark.parametrize(("settings", "seconds"), NO_CHANGE)
def test_what_needs_no_change_has_none(settings, seconds):
    task, config = a_task(4), recipe("default", 1 / 4, **settings)
    same, unchanged = within_budget(a_run(seconds), task, config)
    assert unchanged == config and same.views == task.views


def test_the_pace_is_measured_in_images_and_truths(monkeypatch):
    monkeypatch.undo()
    seconds = iter([0.3, 0.1, 0.5, 0.7])
    monkeypatch.setattr(budget, "_seconds", lambda function, camera, device: (function(camera), next(seconds))[1])
    task = a_task(3)
    pace = Pace.of(tiny.model(5), task)
    assert pace.a_view == pytest.approx(budget.STEP_OVER_IMAGE * 0.1)
    assert (pace.a_truth, pace.a_check) == (0.5, 0.0)
