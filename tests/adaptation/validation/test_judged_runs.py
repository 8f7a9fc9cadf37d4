"""A whole run returns nothing that is worse than the base or its start."""

import signal
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from equal_models import SCALE, same

from mipmap_plugin.adaptation.optimization.checks import checks_until, is_checked
from mipmap_plugin.adaptation.optimization.ending import End
from mipmap_plugin.adaptation.optimization.run import Run
from mipmap_plugin.adaptation.optimization.steering import Steering
from mipmap_plugin.adaptation.optimization.validation import HARM_DB
from mipmap_plugin.adaptation.renderers import Renderer
from mipmap_plugin.adaptation.start import matching
from mipmap_plugin.adaptation.start.matching import Sweeps
from mipmap_plugin.adaptation.start.search import StartSearch
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.recipes import recipe
from mipmap_plugin.wrap import Interrupted, wrap_model

# So bold that every step does harm.
BOLD = {name: 1000 * rate for name, rate in recipe("default", SCALE).rates.model_dump().items()}
STILL = dict.fromkeys(BOLD, 0.0)
HARMFUL = dict(steps=6, extra_views=2, check_every=2, merge_to=1.0, warm_up=0, patience=None, rates=BOLD)


def wrapped(count=40, cameras=None):
    return wrap_model(tiny.model(count), cameras=cameras or tiny.cameras())


def from_the_base(model, image, camera, scale):
    """dB, against the base: of a zoom-out supersampled, of a zoom-in as it is."""
    if scale < 1:
        return psnr(image, model.render(camera.zoomed(scale), scale, "scaled", supersampling=4).image)
    return psnr(resize(image, camera.size, "area"), model.render(camera).image)


@pytest.mark.parametrize("steered", [True, False])
@pytest.mark.parametrize("scale", [1 / 4, 4])
def test_harmful_steps_return_nothing_worse_than_the_base_and_the_start(monkeypatch, scale, steered):
    if not steered:
        monkeypatch.setattr(Steering, "is_harmful", lambda self, psnr, rising: False)
    model = wrapped()
    started, adapted = model.adapt(scale, **{**HARMFUL, "rates": STILL}), model.adapt(scale, **HARMFUL)
    for camera in tiny.cameras(3, seed=9):  # of neither set
        small = camera.zoomed(scale)
        images = model.render(small).image, started.render(small).image, adapted.render(small).image
        base, first, final = (from_the_base(model, image, camera, scale) for image in images)
        assert final >= max(base, first) - HARM_DB


def test_a_report_says_which_state_was_returned_and_why(monkeypatch):
    monkeypatch.setattr(Steering, "is_harmful", lambda self, psnr, rising: False)
    report = wrapped().adapt(SCALE, **HARMFUL).report
    found, name = report.validation, "the start, the closed form"
    assert list(found) == ["the base as it is", name, "the last state"]
    assert found["the last state"] < found[name] - 3
    assert report.returned == f"{name}: {found[name]:.2f} dB on validation views, the last state {found['the last state']:.2f} dB"


def test_steps_that_were_taken_back_are_marked():
    model = wrapped()
    adapted = model.adapt(SCALE, **HARMFUL)
    assert [(point.step, point.taken_back) for point in adapted.report.curve] == [(0, False), (2, True), (4, True), (6, True)]
    assert len({point.validation_db for point in adapted.report.curve}) == 1  # what the run went on with each time
    assert same(adapted.model, model.adapt(SCALE, **{**HARMFUL, "rates": STILL}).model)


def test_a_run_goes_on_gently_after_harm():
    boldly = {name: 10 * rate for name, rate in recipe("default", SCALE).rates.model_dump().items()}
    points = wrapped().adapt(SCALE, **{**HARMFUL, "steps": 16, "decay": 1.0, "rates": boldly}).report.curve
    assert points[1].taken_back and not points[-1].taken_back
    assert points[-1].validation_db > points[0].validation_db + 0.5


def test_a_run_that_gained_nothing_by_a_quarter_of_its_steps_takes_nothing_back_from_there_on():
    points = wrapped().adapt(SCALE, **{**HARMFUL, "steps": 16, "warm_up": 0.25, "gathering": 0.25}).report.curve
    assert [point.step for point in points if point.taken_back] == [1, 2, 3, 4]


def test_the_last_state_is_returned_where_it_is_asked_for():
    report = wrapped().adapt(SCALE, returns="last", **HARMFUL).report
    assert report.returned == "the last state"
    assert report.validation["the last state"] < report.validation["the start, the closed form"] - 3
    assert not any(point.taken_back for point in report.curve)


@pytest.mark.parametrize("closed_form", [True, False])
def test_a_budget_of_nothing_returns_the_start(closed_form, monkeypatch):
    model, settings = wrapped(), dict(merge_to=1.0, closed_form=closed_form)
    adapted = model.adapt(SCALE, time_budget_s=1e-6, **settings)
    assert [point.step for point in adapted.report.curve] == [0]
    monkeypatch.setattr(matching, "sweeps_over", lambda _: Sweeps((), ()))  # there is no time to match blend weights
    assert same(adapted.model, model.adapt(SCALE, steps=0, **settings).model)
    assert same(adapted.model, model.model) != closed_form


@pytest.mark.parametrize(
    ("settings", "checks"),
    [
        (dict(steps=360), [*range(4, 37, 4), *range(50, 351, 50), 360]),
        (dict(steps=40, warm_up=0.1), [1, 2, 3, 4, *range(6, 37, 6), 40]),
        (dict(steps=12, warm_up=0), [5, 10, 12]),
        (dict(steps=6, warm_up=0, check_every=2), [2, 4, 6]),
    ],
)
def test_short_runs_are_checked_more_often_and_so_is_the_warm_up(settings, checks):
    config = recipe("default", SCALE, **settings)
    assert [step for step in range(1, config.steps + 1) if is_checked(step, config)] == checks
    assert [step for step in range(1, config.steps + 1) if checks_until(config, step) > checks_until(config, step - 1)] == checks


@pytest.mark.parametrize(
    ("settings", "steps"),
    [(dict(steps=5, check_every=3), [0, 3, 5]), (dict(steps=3, check_every=50), [0, 3]), (dict(steps=9, check_every=2, target_db=0.0), [0, 2])],
)
def test_a_curve_has_its_first_and_its_last_point(settings, steps):
    report = wrapped().adapt(SCALE, **{"extra_views": 0, "warm_up": 0, **settings}).report
    assert [point.step for point in report.curve] == steps
    assert (report.curve[0].psnr_db, report.curve[-1].psnr_db is None) == (None, False)


def test_a_run_that_ends_between_two_checks_is_looked_at_all_the_same(monkeypatch):
    reasons = iter([None, None, End.OBSERVER])
    monkeypatch.setattr(Run, "reason_to_stop", lambda run, config: next(reasons))
    report = wrapped().adapt(SCALE, steps=9, check_every=50, extra_views=0, warm_up=0).report
    assert (report.ended_by, [point.step for point in report.curve]) == ("its observer", [0, 2])


def with_extras() -> VanillaModel:
    """A model with a column that 3DGS does not know."""
    return tiny.model(40).with_extras({"confidence": np.arange(40, dtype=np.float32)})


@pytest.mark.parametrize(("at", "pruned"), [(2, True), (3, True), (5, False)])  # at a check that takes back, and between two
def test_a_resumed_run_takes_back_as_the_whole_one_did(tmp_path, at, pruned):
    settings = {**HARMFUL, "prune_every": 1 if pruned else 50, "min_opacity": 0.4, "steps": 7, "check_every": 2}
    model = wrap_model(with_extras(), cameras=tiny.cameras())
    whole = model.adapt(SCALE, **settings)
    with pytest.raises(Interrupted):
        model.adapt(SCALE, resume=tmp_path / "run", observe=lambda step, *_: step == at and signal.raise_signal(signal.SIGINT), **settings)
    resumed = model.adapt(SCALE, resume=tmp_path / "run", **settings)
    assert any(point.taken_back for point in whole.report.curve)
    facts = [[(p.step, p.psnr_db, p.validation_db, p.gaussians, p.taken_back) for p in each.report.curve] for each in (whole, resumed)]
    assert facts[0] == facts[1]
    files = [each.save(tmp_path / f"{number}.ply") for number, each in enumerate((whole, resumed))]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert "confidence" in read_ply(files[0]).columns  # the start is returned, whatever was pruned after it


def test_the_closed_form_alone_is_judged_too(monkeypatch):
    report = wrapped().adapt(SCALE, recipe="instant").report
    assert report.validation["the start, the closed form"] > report.validation["the base as it is"] + 3
    assert report.returned == "the start, the closed form"


def test_a_start_that_is_worse_than_the_base_is_not_returned(monkeypatch):
    monkeypatch.setattr(StartSearch, "best", lambda self: (tiny.model(40, seed=5), "another scene"))
    model = wrapped()
    adapted = model.adapt(SCALE, recipe="instant")
    assert adapted.report.returned.startswith("the base as it is: ")
    assert same(adapted.model, model.model)


@pytest.mark.parametrize("viewer", ["spark", "playcanvas", "gaussian-splats-3d"])
def test_splats_that_are_rounded_once_for_all_views_give_the_same_images(viewer):
    """Spark rounds them for all cameras alike, but for their places, which it keeps relative to the eye."""
    base = wrap_model(tiny.model(40), cameras=tiny.cameras(3), backend="cpu")
    draw, splats = Renderer(base.backend()[0], base.effects(viewer=viewer)), base.model.gaussians().detach()
    alone = draw.of(splats)
    for camera in base.cameras:
        assert torch.equal(alone(camera), draw(splats, camera))


def test_an_order_that_rounding_would_change_is_that_of_the_splats_before():
    """antimatter15/splat draws the larger of two splats at one depth first; rounded to 8 bits their opacities are the same."""
    one = tiny.gaussians(1).detach()
    pair = replace(one.joined(one), opacities=torch.tensor([0.5001, 0.5002]), sh=torch.stack([torch.zeros(4, 3), torch.ones(4, 3)]))
    base = wrap_model(tiny.model(4), cameras=tiny.cameras(1), backend="cpu")
    draw = Renderer(base.backend()[0], base.effects(viewer="antimatter15"))
    assert torch.equal(draw.of(pair)(base.cameras[0]), draw(pair, base.cameras[0]))
