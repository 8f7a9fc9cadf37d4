"""Adapting ends when the curve says so, and says why; whoever watches sees the model while the clock stands."""

import time
from dataclasses import replace
from itertools import pairwise

import pytest
import tiny
import torch

from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

STEPS = dict(steps=12, extra_views=0, check_every=2, patience=None)


def wrapped(**trained):
    return wrap_model(tiny.model(30), cameras=tiny.cameras(2), backend="reference", **trained)


def test_the_target_ends_the_run_at_the_first_check_that_reaches_it():
    whole = wrapped().adapt(1 / 4, **STEPS).report
    target = whole.curve[2].psnr_db
    first = next(point for point in whole.curve if point.psnr_db is not None and point.psnr_db >= target)
    report = wrapped().adapt(1 / 4, target_db=target, **STEPS).report
    assert report.ended_by == f"target of {target:g} dB against the pseudo truth"
    assert report.curve[-1].step == first.step < whole.curve[-1].step


def test_a_target_out_of_reach_leaves_the_steps_to_end_it():
    assert wrapped().adapt(1 / 4, target_db=200, **STEPS).report.ended_by == "12 steps"


@pytest.mark.parametrize(("settings", "scale", "steps"), [({}, 1 / 4, 0), ({"returns": "last"}, 1 / 4, 12), ({}, 2, 12)])
def test_no_step_is_taken_where_nobody_could_see_what_it_gains(settings, scale, steps):
    """A splat as large as a sky is the same at every scale. A zoom-in is compared with the base, which does not tell what its truth has."""
    sky = replace(tiny.gaussians(1, degree=0), scales=torch.full((1, 3), 100.0), opacities=torch.ones(1))
    base = wrap_model(VanillaModel.from_gaussians(sky, tiny.model(1).trained), cameras=tiny.cameras(4), backend="reference")
    report = base.adapt(scale, **STEPS, **settings).report
    assert report.curve[0].validation_db == pytest.approx(54.15, abs=0.01) and report.curve[-1].step == steps
    alike = "the start, which differs from the pseudo truth by less than a display shows"
    assert report.ended_by == (f"{steps} steps" if steps else alike)


def test_the_observer_sees_every_step_and_the_model_of_that_step():
    seen = []
    camera = tiny.cameras(1)[0].zoomed(1 / 4)
    adapted = wrapped().adapt(1 / 4, observe=lambda step, seconds, show: seen.append((step, seconds, show(camera))), **STEPS)
    assert [step for step, _, _ in seen] == list(range(13))
    assert all(before[1] < after[1] for before, after in pairwise(seen))
    assert torch.equal(seen[-1][2], adapted.render(camera).image)
    assert not torch.equal(seen[0][2], seen[-1][2]) and not any(image.requires_grad for _, _, image in seen)


def test_the_clock_stands_while_somebody_looks(monkeypatch):
    now = [0.0]

    def look(*_):
        now[0] += 1000

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    assert wrapped().adapt(1 / 4, observe=look, **STEPS).report.seconds["total"] == 0
    assert now[0] == 13_000


def test_watching_changes_nothing():
    camera = tiny.cameras(1)[0].zoomed(1 / 4)
    watched = wrapped().adapt(1 / 4, observe=lambda step, seconds, show: show(camera), **STEPS).model.parameters()
    alone = wrapped().adapt(1 / 4, **STEPS).model.parameters()
    assert all(torch.equal(watched[name], alone[name]) for name in alone)


@pytest.mark.parametrize("recipe", ["default", "paper", "instant"])
def test_at_scale_one_there_is_nothing_to_do(recipe):
    model, steps = wrapped(), []
    adapted = model.adapt(1, recipe=recipe, observe=lambda step, *_: steps.append(step))
    assert adapted.report.ended_by == "scale 1, at which the base is right as it is" and steps == []
    assert all(torch.equal(tensor, model.model.parameters()[name]) for name, tensor in adapted.model.parameters().items())


def test_at_scale_one_a_base_of_another_filter_becomes_classic_where_that_is_asked_for():
    adapted = wrapped(screen_filter="antialiased").adapt(1, viewer="classic", steps=2, extra_views=0)
    assert adapted.report.ended_by == "2 steps" and adapted.effects.screen_filter == "classic"
