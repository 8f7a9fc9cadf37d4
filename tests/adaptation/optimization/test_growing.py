"""Growing on trial: what views do not get over is undone, and was the last."""

import math
import signal
from types import SimpleNamespace

import numpy as np
import pressing
import pytest
import tiny
import torch

from mipmap_plugin.adaptation.optimization.by_rows import ByRows
from mipmap_plugin.adaptation.optimization.growing import frozen_parameters
from mipmap_plugin.adaptation.optimization.run import Task, Trial
from mipmap_plugin.adaptation.optimization.validation import Quality, Validation
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.upsamplers import register_upsampler
from mipmap_plugin.config import LearningRates
from mipmap_plugin.recipes import recipe
from mipmap_plugin.wrap import Interrupted, wrap_model

# Every splat that is seen grows at steps 2, 4 and 6, if nothing forbids it.
EAGER = dict(returns="last", recipe="thorough", steps=8, prune_every=2, check_every=1, densify_gradient=1e-12, min_opacity=0.0, views_per_step=2)


@pytest.fixture(autouse=True)
def upsampler():
    register_upsampler("mine", lambda image, size: resize(image, size, "lanczos"), replace=True)


@pytest.fixture
def judged(monkeypatch):
    """Let the views agree with the base by these dB: at the start, at each judgment; the last stays."""

    def by(*agreements):
        left = list(agreements)
        monkeypatch.setattr(Task, "agreement", lambda *_: left.pop(0) if len(left) > 1 else left[0])

    return by


def adapted(resume=None, observe=None, **settings):
    model = wrap_model(tiny.model(), cameras=tiny.cameras(6))
    return model.adapt(2, upsampler="mine", resume=resume, observe=observe, **{**EAGER, **settings})


def counts(run) -> list[int]:
    """How many splats there were after each step."""
    return [point.gaussians for point in run.report.curve[1:]]


def test_splats_grow_while_views_get_over_it(judged):
    judged(30.0, 30.0, 31.0)
    run = adapted()
    sizes = counts(run)
    assert run.report.ended_by == "8 steps"
    assert len(tiny.model()) == sizes[0] < sizes[1] < sizes[3] < sizes[5]


def test_a_growth_that_views_do_not_get_over_is_undone_and_was_the_last(judged):
    judged(30.0, 30.5, 29.0, 99.0)
    run = adapted()
    sizes = counts(run)
    assert sizes[1] < sizes[3] and sizes[5:] == [sizes[1]] * 3
    assert run.report.ended_by == "8 steps; growth was undone at step 6: the views were farther from the base than at the start"


def test_centers_move_once_something_has_grown(judged):
    judged(30.0)

    def means(**settings):
        return adapted(**settings).model.parameters()["means"]

    assert torch.equal(means(densify_gradient=1e9), means(steps=0))
    unmoved = recipe("thorough", 2, upsampler="mine").rates.model_copy(update={"means": 0.0})
    assert not torch.equal(means(), means(rates=unmoved))


def test_centers_go_on_moving_when_a_growth_has_passed_and_stand_when_the_first_was_undone():
    def names(**trial):
        return frozen_parameters(SimpleNamespace(trial=Trial(30.0, **trial)))

    assert names() == names(undone_at=4) == ("means",)
    assert names(before={}) == names(passed=True) == names(passed=True, undone_at=6) == ()


@pytest.mark.parametrize("ending", [dict(steps=3), dict(target_db=1.0, check_every=2)])
def test_a_growth_is_judged_when_the_run_ends(judged, ending):
    judged(30.0, 10.0)
    run = adapted(**ending)
    assert run.report.gaussians_after == len(tiny.model())
    assert "growth was undone at step" in run.report.ended_by


def test_the_curve_ends_with_the_state_that_is_left_when_a_growth_is_undone(judged):
    """The check that ends the run, with the growth of its step, comes before that is judged."""
    judged(30.0, 10.0)
    ending = dict(target_db=1.0, check_every=2)
    undone, ungrown = (adapted(**ending, **grows).report.curve[-1] for grows in ({}, dict(densify_gradient=1e9)))
    assert (undone.step, undone.gaussians, undone.validation_db) == (2, len(tiny.model()), ungrown.validation_db)


def test_what_is_no_number_is_undone(judged):
    judged(30.0, math.nan)
    assert adapted().report.gaussians_after == len(tiny.model())


def test_a_growth_that_has_passed_is_not_judged_again(judged):
    judged(30.0, 30.0, 10.0)
    assert adapted(most_growth=1.5).report.gaussians_after > len(tiny.model())  # there is no room for a second


def test_without_growing_nothing_is_on_trial(monkeypatch):
    monkeypatch.setattr(Task, "agreement", lambda *_: pytest.fail("asked"))
    start, end = (adapted(densify_gradient=None, steps=steps).model.parameters()["means"] for steps in (0, 2))
    assert not torch.equal(start, end)


@pytest.mark.parametrize("backend", ["reference", "cpu"])  # the latter moves splats itself
def test_published_growing_is_not_on_trial(monkeypatch, backend):
    monkeypatch.setattr(Task, "agreement", lambda *_: pytest.fail("asked"))
    model = wrap_model(tiny.model(), cameras=tiny.cameras(6), backend=backend)
    run = model.adapt(2, recipe="paper", steps=3, prune_every=2, densify_gradient=1e-12)
    assert run.report.gaussians_after > len(tiny.model())


def test_by_rows_the_same_splats_grow_as_by_autograd(monkeypatch):
    pytest.importorskip("numba", reason="numba, the extra `cpu`, is not installed")
    stepped, step = [], ByRows.step
    monkeypatch.setattr(ByRows, "step", lambda *args, **options: stepped.append(1) or step(*args, **options))
    runs = []
    for _ in range(2):
        model = wrap_model(tiny.model(), cameras=tiny.cameras(6), backend="cpu")
        runs.append(model.adapt(1 / 2, recipe="paper", steps=8, prune_every=3, densify_gradient=2e-3, rates=LearningRates(means=0.1)))
        assert len(stepped) == 8
        monkeypatch.setattr(ByRows, "of", lambda *_: None)
    by_rows, by_autograd = (run.model.parameters() for run in runs)
    assert len(tiny.model()) < len(by_rows["means"]) < 3 * len(tiny.model())
    for name, tensor in by_autograd.items():
        torch.testing.assert_close(by_rows[name], tensor, atol=2e-3, rtol=2e-3, msg=lambda text, name=name: f"{name}: {text}")


def test_agreement_at_the_start_is_that_of_the_closed_form(monkeypatch):
    found = []
    agreement = Task.agreement
    monkeypatch.setattr(Task, "agreement", lambda *given: found.append(agreement(*given)) or found[-1])
    adapted(steps=6)  # as many as there are views, for no more are upsampled than are used
    base = wrap_model(tiny.model(), cameras=tiny.cameras(6))
    closed = base.adapt(2, recipe="instant", crispness=0, views="train")
    errors = []
    for view in tiny.cameras(6):
        truth = base.render(view).image.clamp(0, 1)
        errors.append((resize(closed.render(view.zoomed(2)).image, tuple(truth.shape[:2]), "pil-bicubic") - truth).square().mean())
    assert found[0] == pytest.approx(-10 * math.log10(sum(errors) / 6), abs=0.01)


@pytest.mark.parametrize(("agreements", "pressed"), [((30.0, 20.0), 3), ((30.0, 31.0, 32.0), 5)])  # with a growth on trial; after its judgment
def test_a_resumed_run_equals_an_uninterrupted_one(judged, monkeypatch, tmp_path, agreements, pressed):
    judged(*agreements)
    whole = adapted()
    judged(*agreements)
    with monkeypatch.context() as patched:
        pressing.in_step(patched, lambda: signal.raise_signal(signal.SIGINT))(pressed)
        with pytest.raises(Interrupted):
            adapted(resume=tmp_path / "state")
    resumed = adapted(resume=tmp_path / "state")
    assert resumed.save(tmp_path / "resumed.ply").read_bytes() == whole.save(tmp_path / "whole.ply").read_bytes()
    assert resumed.report.ended_by == whole.report.ended_by


def test_rows_that_are_as_many_but_others_have_no_columns_of_the_base(monkeypatch):
    """Pruned after the first step, and grown to as many as the base has, which is where growing ends, after the second."""
    found = iter([30.0, 40.0, 39.0])  # in the beginning, after step 2, after step 4
    monkeypatch.setattr(Validation, "quality", lambda self, model: Quality(*[next(found)] * 2))
    chosen = lambda states: (list(states)[2], dict.fromkeys(states, 0.0), dict.fromkeys(states, ()), dict.fromkeys(states, (0.0,)))  # noqa: E731
    monkeypatch.setattr(Validation, "choose", lambda self, states, allowed: chosen(states))
    base = tiny.model(40).with_extras({"confidence": np.arange(40, dtype=np.float32)})
    rates = LearningRates(means=0.05, scales=0.02, quats=0.004, opacities=0.05, sh0=0.015, shN=0.02)  # with which one splat is pruned
    settings = dict(most_growth=1, densify_gradient=1e-12, min_opacity=0.5, prune_every=1, steps=4, check_every=2, merge_to=1.0, warm_up=0)
    settings |= dict(rates=rates, views_per_step=3)
    run = wrap_model(base, cameras=tiny.cameras(6)).adapt(1 / 2, extra_views=0, closed_form=False, **settings)
    assert run.report.returned.startswith("the state after step 2") and len(run.model) == len(base)
    assert not torch.equal(run.model.parameters()["means"], base.parameters()["means"])
    assert "confidence" not in run.model.extras
