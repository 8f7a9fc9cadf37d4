"""The time left is told right early, by a clock on which every part of a run has a price."""

import time
from dataclasses import replace
from types import SimpleNamespace

import moving
import pytest
import tiny

from mipmap_plugin.adaptation.optimization import loop
from mipmap_plugin.adaptation.optimization.costs import Costs
from mipmap_plugin.adaptation.optimization.estimate import Forecast
from mipmap_plugin.adaptation.optimization.evaluations import Evaluations
from mipmap_plugin.adaptation.optimization.following import Following
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.optimization.validation import Quality, Validation
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.views.schedule import ViewSchedule
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.models import load_model
from mipmap_plugin.models.moving import memory
from mipmap_plugin.process import threads
from mipmap_plugin.recipes import recipe
from mipmap_plugin.wrap import wrap_model

SCALE = 1 / 4
VIEW, TRUTH, CHECK = 0.003, 0.012, 0.05  # s: as of lego_200 on one thread
EVALUATION = 0.03  # s, of a field at a moment


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still until somebody spends time."""
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def spend(seconds):
        now[0] += seconds

    return spend


def run_and_estimates(clock, monkeypatch, base=None, **settings):
    """The whole run's seconds for a `base`, and after each step those that have passed and those that were said to be left."""
    views = [replace(view, time=number % 6 / 5) for number, view in enumerate(tiny.cameras(20, width=16, height=16))]
    config, base, images = recipe("default", SCALE, **settings), base or tiny.model(3), {}
    backend, effects, told = ReferenceBackend(), Effects(1), []

    def truth(view):
        if view not in images:
            clock(TRUTH)
            images[view] = resize(backend.render(base.gaussians(view), view, effects).image.detach(), view.zoomed(SCALE).size, "box")
        return images[view]

    def render(gaussians, camera):
        clock(VIEW)
        return backend.render(gaussians, camera, effects).image

    for view in views:
        base.gaussians(view)  # `evaluate_moments`
    evaluate = memory.Memory.evaluate
    monkeypatch.setattr(memory.Memory, "evaluate", lambda *each: clock(EVALUATION) or evaluate(*each))
    monkeypatch.setattr(Validation, "quality", lambda self, model: clock(CHECK) or Quality(20.0, 20.0))
    monkeypatch.setattr(loop.StepsBar, "update", lambda bar, *_: told.append((run.watch.seconds, bar.seconds_left)))
    task = Task(views, SCALE, truth, [render], False, Validation([], [], SCALE, truth, [render], config.resize))
    task = replace(task, follow=Following(base, views, SCALE))
    run = Run.start(base.copy(), task, config)
    loop.adapt(run, task, config, on_interrupt=lambda run: None)
    return run.watch.seconds, told


@pytest.mark.parametrize("settings", [dict(steps=40), dict(steps=30, views_per_step=1, check_every=5), dict(steps=30, warm_up=0.0, gathering=1.0)])
def test_after_a_tenth_of_the_run_the_estimate_is_right_within_thirty_percent(clock, monkeypatch, settings):
    total, told = run_and_estimates(clock, monkeypatch, **settings)
    for passed, left in told:
        if passed > total / 10:
            assert left == pytest.approx(total - passed, rel=0.3, abs=0.01 * total)
    assert told[-1][1] == pytest.approx(0, abs=1e-6)


def test_evaluations_of_a_field_are_foretold_as_rates_fall(clock, monkeypatch, tmp_path):
    """Most of them lie in the first half of a run."""
    total, told = run_and_estimates(clock, monkeypatch, load_model(moving.write_deformable(tmp_path / "moving")), steps=60)
    assert told[30][0] > 0.6 * total
    for passed, left in told:
        if passed > total / 10:
            assert left == pytest.approx(total - passed, rel=0.3, abs=0.01 * total)


def test_slow_first_steps_are_soon_forgotten():
    """Memory, caches and threads have to be found for them."""
    views, config = tiny.cameras(4), recipe("default", SCALE, steps=40, views_per_step=2, warm_up=0)
    forecast = Forecast(ViewSchedule(views, config), config, Evaluations(Following(), config))
    costs = Costs(truths=dict.fromkeys(views, 0.0))
    seconds = [5.0 + 0.1 * step for step in range(1, 41)]  # the first takes 50 times as long
    left = [forecast.left(step, spent, costs, 1.0) for step, spent in enumerate(seconds, start=1)]
    assert left[0] > 100 and left[3] == pytest.approx(36 * 0.1) and left[-1] == 0


def test_a_run_of_millions_of_steps_that_a_budget_ends_begins_at_once():
    views, config = tiny.cameras(4), recipe("default", SCALE, steps=3 * 10**6, views_per_step=3)
    began = time.perf_counter()
    forecast = Forecast(ViewSchedule(views, config), config, Evaluations(Following(), config))
    assert forecast.left(10, 1.0, Costs(truths=dict.fromkeys(views, 0.0)), 1.0) > 0 and time.perf_counter() - began < 0.5


def test_a_budget_bounds_the_estimate(clock, monkeypatch):
    _, told = run_and_estimates(clock, monkeypatch, steps=40, time_budget_s=0.4)
    assert all(left <= max(0.0, 0.4 - passed) for passed, left in told)


def test_truth_and_validation_have_rows_of_their_own_in_the_report():
    seconds = wrap_model(tiny.model(10), cameras=tiny.cameras(4)).adapt(SCALE, steps=4, extra_views=2).report.seconds
    assert all(seconds[phase] > 0 for phase in ("pseudo truth", "validation", "optimization"))
    assert sum(seconds[phase] for phase in seconds.keys() - {"total"}) == pytest.approx(seconds["total"], rel=0.2)


def test_truths_are_made_side_by_side_and_ahead():
    """Some for each thread, from the steps that come next; each once."""
    made, views = [], tiny.cameras(12)
    config = recipe("default", SCALE, steps=40, views_per_step=2, warm_up=0, gathering=1.0)
    run = SimpleNamespace(student=tiny.model(10), costs=Costs(), step=3, progress=lambda config: 0.0)
    task = SimpleNamespace(scale=SCALE, truth=lambda view: made.append((view, threads.side_by_side_now())))
    order = ViewSchedule(views, config)
    with threads.limited(2, shared=True):
        loop._make_truths(run, task, config, order, order(3, 0.0))
        count = 2 * loop.TRUTHS_AT_ONCE
        assert len({view for view, _ in made}) == count and {at_once for _, at_once in made} == {2}
        assert {*order(3, 0.0)} <= {view for view, _ in made} <= {view for step in range(3, 20) for view in order(step, 0.0)}
        loop._make_truths(run, task, config, order, order(3, 0.0))
    assert len(made) == count
