"""A run with a time budget has as many steps and views as fit into it."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.curve import CurvePoint, Stopwatch
from mipmap_plugin.adaptation.optimization import budget
from mipmap_plugin.adaptation.optimization.budget import SPARE, USES, Pace, plan_note, within_budget
from mipmap_plugin.adaptation.optimization.ending import End
from mipmap_plugin.adaptation.optimization.evaluations import Evaluations
from mipmap_plugin.adaptation.optimization.following import Following
from mipmap_plugin.adaptation.optimization.optimizer import make_optimizer
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.optimization.steering import Steering
from mipmap_plugin.adaptation.optimization.validation import Validation, no_validation
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.recipes import recipe

STILL = Following()
PACE = Pace(a_view=0.01, a_truth=0.02, a_check=0.05, a_choice=0.25)


@pytest.fixture(autouse=True)
def known_pace(monkeypatch):
    monkeypatch.setattr(Pace, "of", classmethod(lambda cls, student, task, size, left: PACE))


def a_task(views: int) -> Task:
    truth, render = (lambda view: torch.zeros(*view.size, 3)), (lambda splats, camera: torch.zeros(*camera.size, 3))
    return Task(tiny.cameras(views), 1 / 4, truth, [render], False, no_validation(truth, render))


def a_run(seconds: float, step: int = 0) -> Run:
    student = tiny.model(5).copy()
    optimizer = make_optimizer(student, recipe("default", 1 / 4), 0.1)
    return Run(student, optimizer, Stopwatch(seconds=seconds), None, Steering.begin(student, 0.0), step=step)


def test_steps_fill_the_budget_with_their_truths_and_checks():
    config = recipe("default", 1 / 4)
    a_step = config.views_per_step * (0.01 + 0.02 / USES) + 0.05 / config.check_every
    assert PACE.steps(config, 2.0, STILL) == int(SPARE * 2.0 / a_step)
    assert PACE.steps(config, 0.0, STILL) == 1


def test_a_short_run_has_fewer_views():
    task, config = a_task(40), recipe("default", 1 / 4, time_budget_s=3.0)
    fewer, shorter = within_budget(a_run(2.5), task, config)
    assert shorter.steps == PACE.steps(config, 0.5 - PACE.a_choice, STILL)
    assert len(fewer.views) == -(-config.views_per_step * shorter.steps // USES) < 40 and set(fewer.views) < set(task.views)
    assert shorter.warm_up_steps < config.warm_up_steps


def test_a_run_that_goes_on_keeps_its_plan():
    run, config = a_run(1.0), recipe("default", 1 / 4, time_budget_s=3.0)
    task, planned = within_budget(run, a_task(40), config)
    run.step, run.watch.seconds = 3, 2.5
    again, same = within_budget(run, a_task(40), config)
    assert same == planned and [view.name for view in again.views] == [view.name for view in task.views]


def test_what_was_planned_and_taken_is_told():
    run, config = a_run(1.0, step=5), recipe("default", 1 / 4, time_budget_s=3.0)
    assert plan_note(run, config) == ""
    run.planned = 8
    assert plan_note(run, config) == ""
    run.ended_by = End.TIME
    assert plan_note(run, config) == " (after 5 of 8 steps, planned for the time budget in place of 360)"
    run.step = 8
    assert plan_note(run, config) == " (planned for the time budget in place of 360)"


@pytest.mark.parametrize(("settings", "steps"), [(dict(), PACE.steps(recipe("default", 1 / 4), 39.75, STILL)), (dict(steps=400), 400)])
def test_time_that_is_left_is_used_unless_the_steps_were_asked_for(settings, steps):
    config = recipe("default", 1 / 4, time_budget_s=40.0, **settings)
    assert within_budget(a_run(0.0), a_task(4), config)[1].steps == pytest.approx(steps, abs=1) and steps > recipe("default", 1 / 4).steps
    assert within_budget(a_run(0.0), a_task(4), config.model_copy(update={"time_budget_s": 1e6}))[1].steps == max(400, config.most_steps or 0)


def test_evaluations_of_a_field_take_their_part_of_a_budget():
    config = recipe("default", 1 / 4)
    follow = SimpleNamespace(moments=6, reach=0.5, rounds=0.0, unknown=6, evaluation=0.1, seconds=0.0)
    steps = PACE.steps(config, 4.0, follow)

    def seconds(steps):
        return steps * PACE.a_step(config) + Evaluations(follow, config.model_copy(update={"steps": steps})).of_all_steps()

    assert PACE.steps(config, 1e6, follow) == config.most_steps  # no others are counted
    assert 10 < steps < PACE.steps(config, 4.0, STILL) / 1.3 and seconds(steps) <= SPARE * 4.0 < seconds(steps + 1)


def test_time_is_kept_for_choosing_after_the_steps():
    run, config = a_run(1.0), recipe("default", 1 / 4, time_budget_s=3.0)
    run.curve = [CurvePoint(step=0, seconds=1.0, psnr_db=None, validation_db=20.0, gaussians=5)]
    _, planned = within_budget(run, a_task(4), config)
    assert run.reserved == PACE.a_choice and planned.steps == PACE.steps(config, 3.0 - 1.0 - PACE.a_choice, STILL)
    assert run.progress(planned) == pytest.approx(0, abs=0.01)
    run.watch.seconds = 3.0 - PACE.a_choice
    assert run.progress(planned) == 1 and run.reason_to_stop(planned) is End.CHOICE


def test_rates_decay_by_the_steps_or_by_the_budget_whichever_is_used_up_first():
    def progress(step, seconds, before=0.0, budget=60.0):
        run = a_run(seconds, step)
        run.curve = [CurvePoint(step=0, seconds=before, validation_db=20.0, gaussians=5)]
        return run.progress(AdaptConfig(steps=100, time_budget_s=budget))

    assert [progress(*used) for used in ((0, 0.0), (50, 15.0), (10, 45.0), (100, 10.0), (5, 90.0))] == [0, 0.5, 0.75, 1, 1]
    assert progress(25, 1e6, budget=None) == 0.25 and progress(0, 40.0, before=40.0) == 0 and progress(0, 50.0, before=40.0) == 0.5


def test_steps_that_were_taken_before_the_first_check_are_not_told_as_the_start():
    run, config = a_run(4.0, step=2), recipe("default", 1 / 4, time_budget_s=3.0)
    run.curve = [CurvePoint(step=0, seconds=1.0, validation_db=20.0, gaussians=5)]
    assert run.reason_to_stop(config) is End.TIME


NO_CHANGE = [(dict(), 0.0), (dict(time_budget_s=1e6, steps=360), 0.0), (dict(time_budget_s=3.0), 4.0), (dict(time_budget_s=3.0, gathering=0.0), 0.0)]


@pytest.mark.parametrize(("settings", "seconds"), NO_CHANGE)
def test_what_needs_no_change_has_none(settings, seconds):
    task, config = a_task(4), recipe("default", 1 / 4, **settings)
    same, unchanged = within_budget(a_run(seconds), task, config)
    assert unchanged == config and same.views == task.views


def test_a_step_that_does_not_fit_is_not_begun(monkeypatch):
    """As of very large views, of which a truth alone takes longer than is left."""
    monkeypatch.setattr(Pace, "of", classmethod(lambda cls, *_: Pace(a_view=1.0, a_truth=8.0, a_check=0.1, a_choice=0.25)))
    run, config = a_run(1.0), recipe("default", 1 / 4, time_budget_s=10.0)
    run.curve = [CurvePoint(step=0, seconds=1.0, psnr_db=None, validation_db=20.0, gaussians=5)]
    within_budget(run, a_task(4), config)
    assert run.reason_to_stop(config) is End.CHOICE and run.reserved == 9.25


def test_of_large_views_nothing_is_drawn_that_takes_longer_than_is_left(monkeypatch):
    monkeypatch.undo()
    drawn = []
    monkeypatch.setattr(budget, "_seconds", lambda function, camera, device: (drawn.append(camera.size), 0.01)[1])
    large = [camera.resized(8 * budget.WINDOW, 4 * budget.WINDOW) for camera in tiny.cameras(2)]
    task = replace(a_task(2), views=large, scale=1.0)
    pace = Pace.of(tiny.model(5), task, left=0.3)
    assert drawn == [(budget.WINDOW, budget.WINDOW)]  # the middle of one
    assert pace.a_view == pytest.approx(0.01 * 32 * budget.STEP_OVER_IMAGE)
    assert pace.a_truth == pytest.approx(0.01 * 32 * budget.TRUTH_OVER_IMAGE)


def test_the_pace_is_measured_in_images_and_truths(monkeypatch):
    monkeypatch.undo()
    seconds = iter([0.3, 0.1, 0.5, 0.7])
    monkeypatch.setattr(budget, "_seconds", lambda function, camera, device: (function(camera), next(seconds))[1])
    task = a_task(3)
    pace = Pace.of(tiny.model(5), task)
    assert pace.a_view == pytest.approx(budget.STEP_OVER_IMAGE * 0.1)
    assert (pace.a_truth, pace.a_check) == (0.5, 0.0)


def test_validation_is_measured_as_it_is_done_in_the_middle_of_large_views_and_in_all_viewers(monkeypatch):
    monkeypatch.undo()
    seen = []

    def draw(splats, camera):
        seen.append(camera.size)
        return torch.zeros(camera.height, camera.width, 3)

    def seconds(function, camera, device):
        began = len(seen)
        function(camera)
        return sum(width * height for width, height in seen[began:])

    monkeypatch.setattr(budget, "_seconds", seconds)
    whole = [camera.resized(40, 30) for camera in tiny.cameras(7)]
    steering, choosing = ([view.window(8, 8) for view in some] for some in (whole[2:4], whole[4:]))
    truth = cache(lambda view: draw(None, view))
    for view in steering:  # which were used to choose the start
        truth(view)
    validation = Validation(steering, choosing, 1.0, truth, [draw, draw], "area")
    task = replace(a_task(2), views=whole[:2], scale=1.0, renders=[draw], validation=validation)
    pace = Pace.of(tiny.model(5), task)
    assert pace.a_view == budget.STEP_OVER_IMAGE * 40 * 30
    assert pace.a_check == 2 * 2 * 64
    assert pace.a_choice == 3 * 64 * (1 + 2 * budget.STATES)  # the truth, and each state in two viewers
    seen.clear()
    pace = Pace.of(tiny.model(5), replace(task, validation=replace(validation, steering=whole[2:4], choosing=whole[4:])))
    assert (pace.a_check, len(seen)) == (2 * 2 * 40 * 30, 1)  # the image tells it
