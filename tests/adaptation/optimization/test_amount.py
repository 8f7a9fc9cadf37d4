"""Large scenes take fewer steps."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import tiny
import torch

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.optimization.amount import (
    LEAST_FRACTION,
    LEAST_IN_BUDGET,
    LEAST_MOMENTS,
    OVERSAMPLING,
    affordable,
    affordable_for_model,
    affordable_moments,
    as_taken,
    splats_in_view,
)  # fmt: skip
from mipmap_plugin.adaptation.views.for_validation import MIN_VIEWS
from mipmap_plugin.models.base import Traits
from mipmap_plugin.recipes import MOST_DRAWS, recipe


def test_splats_in_view_are_those_whose_centers_are_on_the_image():
    means = torch.tensor([[0.0, 0.0, 2.0], [0.5, 0.0, 2.0], [9.0, 0.0, 2.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.05]])
    view = replace(tiny.cameras(1)[0], viewmat=torch.eye(4))
    assert splats_in_view(means, [view], near=0.2) == pytest.approx(2, abs=1e-4)


@pytest.mark.parametrize(
    ("in_view", "steps", "views"), [(10.0, 360, 150), (MOST_DRAWS / 1440, 360, 150), (MOST_DRAWS / 720, 180, 106), (1e9, 360 * LEAST_FRACTION, 75)]
)
def test_steps_and_views_fall_with_what_views_show_but_not_to_none(in_view, steps, views):
    settings = affordable(recipe("default", 1 / 4), in_view)
    assert (settings.steps, settings.extra_views) == (pytest.approx(steps, abs=1), pytest.approx(views, abs=1))
    assert settings.truth_oversampling == (4 if steps == 360 else OVERSAMPLING)


def test_settings_of_a_large_scene_are_recognized_as_those_that_were_asked_for():
    asked = recipe("default", 1 / 4)
    for draws in range(100, 3000, 7):  # from all steps to a fourth of them
        taken = affordable(asked, MOST_DRAWS / draws)
        assert as_taken(asked, taken) == taken
        other = asked.model_copy(update={"extra_views": 400})
        assert as_taken(other, taken) != taken
    none = recipe("default", 1 / 4, steps=600)
    assert as_taken(none, affordable(asked, 1e9)) == none


@pytest.mark.parametrize(("count", "moments"), [(1_000, 24), (60_000, 15), (10**6, LEAST_MOMENTS)])
def test_a_moving_scene_has_fewer_moments_before_it_has_fewer_steps(count, moments):
    base = SimpleNamespace(traits=Traits(moves=True), work=20.0, parameters=lambda: {"means": torch.tensor([[0.0, 0.0, 2.0]]).expand(count, 3)})
    view, asked = replace(tiny.cameras(1)[0], viewmat=torch.eye(4)), recipe("default", 1 / 4)
    taken = affordable_for_model(asked, base, [view], near=0.2)
    assert affordable_moments(taken, base) == moments and taken.most_draws == asked.most_draws
    assert taken.steps == (360 if count < 10**6 else 90)
    assert affordable_moments(recipe("default", 1 / 4, steps=7), base) == 24


def test_a_time_budget_bounds_the_moments_of_a_moving_scene_alike_on_each_machine():
    base = SimpleNamespace(traits=Traits(moves=True), work=20.0, parameters=lambda: {"means": torch.zeros(50_000, 3)})
    budgets = [affordable_moments(recipe("default", 1 / 4, time_budget_s=seconds), base) for seconds in (1.0, 60.0, 600.0)]
    assert budgets == [LEAST_IN_BUDGET, 6, 24]
    still = SimpleNamespace(traits=Traits(), parameters=base.parameters)
    assert affordable_moments(recipe("default", 1 / 4, time_budget_s=1.0), still) == 24


@pytest.mark.parametrize(("seconds", "views"), [(0.5, MIN_VIEWS), (2.0, 10), (1e4, 16)])
def test_a_time_budget_bounds_the_views_for_validation_alike_on_each_machine(seconds, views):
    base = SimpleNamespace(traits=Traits(), parameters=lambda: {"means": torch.tensor([[0.0, 0.0, 2.0]]).expand(20_000, 3)})
    view, asked = replace(tiny.cameras(1)[0], viewmat=torch.eye(4)), recipe("default", 1 / 4, time_budget_s=seconds)
    taken = affordable_for_model(asked, base, [view], near=0.2)
    assert taken.validation_views == views == affordable_for_model(asked, base, [], near=0.2).validation_views
    assert affordable_for_model(recipe("default", 1 / 4, steps=9), base, [view], near=0.2).validation_views == 16


def test_steps_that_somebody_asks_for_are_taken():
    for wish in (dict(steps=600), dict(time_budget_s=60.0), dict(target_db=30.0)):
        assert recipe("default", 1 / 4, **wish).most_draws is None
    assert recipe("thorough", 1 / 4).most_draws is None
    assert recipe("default", 1 / 4, steps=600, most_draws=7.0).most_draws == 7.0


def test_the_report_says_that_a_large_scene_took_fewer_steps(monkeypatch):
    monkeypatch.setattr("mipmap_plugin.recipes.DEFAULT_OUT", dict(steps=8, most_draws=200.0, check_every=2))
    report = wrap_model(tiny.model(60), cameras=tiny.cameras(4)).adapt(1 / 2, extra_views=0).report
    assert report.curve[-1].step == 3 == report.settings.steps
    assert report.ended_by.startswith("3 steps (of 8, because the scene is large")
