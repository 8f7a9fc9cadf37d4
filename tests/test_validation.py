"""Validation: which views judge, how a model is judged, and that a run returns nothing worse than what it was given."""

import math
import signal
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import torch

from mipmap_plugin.adaptation.optimization import loop
from mipmap_plugin.adaptation.optimization.ending import End
from mipmap_plugin.adaptation.optimization.losses import INVISIBLE_ERROR
from mipmap_plugin.adaptation.optimization.optimizer import make_optimizer, restore_snapshot
from mipmap_plugin.adaptation.optimization.run import Run
from mipmap_plugin.adaptation.optimization.snapshot import Snapshot
from mipmap_plugin.adaptation.optimization.validation import (
    FIRST_RATE_FACTOR,
    HARM_DB,
    LOST_DB,
    LOST_FRACTION,
    RATE_REDUCTION,
    TIE_DB,
    VALIDATION_EVERY,
    VISIBLE_ERROR,
    WINDOW,
    Steering,
    Validation,
    split_validation,
)
from mipmap_plugin.adaptation.renderers import Renderer
from mipmap_plugin.adaptation.start import candidates as start
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.viewpoints import Viewpoints
from mipmap_plugin.adaptation.views import choose_views
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.models.base import Traits
from mipmap_plugin.models.vanilla import Origin, VanillaModel
from mipmap_plugin.recipes import recipe
from mipmap_plugin.scenes.orbits import Orbit
from mipmap_plugin.wrap import Interrupted, wrap_model

VIEWPOINTS = Viewpoints(Orbit.around(tiny.gaussians().means), list)
SCALE = 1 / 4

# So bold that every step does harm.
BOLD = {name: 1000 * rate for name, rate in recipe("default", SCALE).rates.model_dump().items()}
HARMFUL = dict(steps=6, extra_views=2, check_every=2, merge_to=1.0, warm_up=0, patience=None, rates=BOLD)
MANY = 2 * VALIDATION_EVERY  # cameras, of which two are kept back


def wrapped(count=40, cameras=None):
    return wrap_model(tiny.model(count), cameras=cameras or tiny.cameras())


def same(model, other) -> bool:
    return all(torch.equal(tensor, other.parameters()[name]) for name, tensor in model.parameters().items())


# Views


def held_back(cameras, policy, scale=SCALE, **settings):
    config = recipe("default", scale, **{"views": policy, "extra_views": 8, **settings})
    views, _ = choose_views(cameras, VIEWPOINTS, config)
    return split_validation(cameras, views, VIEWPOINTS, scale, config)


def poses(views):
    return {tuple(view.viewmat.flatten().tolist()) for view in views}


@pytest.mark.parametrize("policy", ["given", "train", "test", "jittered", "orbit"])
def test_no_view_of_validation_is_adapted_to(policy):
    cameras = tiny.cameras(MANY) + tiny.cameras(MANY, seed=2, split="test")
    left, judged = held_back(cameras, policy)
    assert len(judged) == len(poses(judged)) == 16
    assert left and not poses(left) & poses(judged)


@pytest.mark.parametrize(("policy", "kept"), [("train", 2), ("jittered", 2), ("given", 0), ("test", 0), ("orbit", 0)])
def test_given_cameras_are_kept_back_only_where_the_choice_is_ours(policy, kept):
    cameras = tiny.cameras(MANY) + tiny.cameras(MANY, seed=2, split="test")
    wanted, _ = choose_views(cameras, VIEWPOINTS, recipe("default", SCALE, views=policy, extra_views=8))
    left, judged = held_back(cameras, policy)
    assert len(poses(cameras) & poses(judged)) == len(wanted) - len(left) == kept


def test_few_cameras_are_all_adapted_to():
    left, judged = held_back(tiny.cameras(VALIDATION_EVERY - 1), "train")
    assert len(left) == VALIDATION_EVERY - 1 and len(judged) == 16


def test_cameras_that_are_kept_back_choose_and_do_not_steer():
    cameras = tiny.cameras(MANY)
    _, judged = held_back(cameras, "train")
    assert not poses(cameras) & poses(judged[::2])
    assert len(poses(cameras) & poses(judged[1::2])) == 2


def test_no_more_cameras_are_kept_back_than_half_of_the_validation_views():
    left, judged = held_back(tiny.cameras(MANY), "train", validation_views=2)
    assert (len(left), len(judged)) == (MANY - 1, 2)


@pytest.mark.parametrize(("steps", "views"), [(0, 8), (1, 4), (360, 16)])
def test_a_start_is_chosen_by_more_views_than_a_few_steps_are(steps, views):
    assert len(held_back(tiny.cameras(MANY), "train", steps=steps)[1]) == views
    assert len(held_back(tiny.cameras(MANY), "train", steps=steps, validation_views=2)[1]) == 2


def test_without_cameras_validation_has_an_orbit_of_its_own(monkeypatch):
    monkeypatch.setattr("mipmap_plugin.adaptation.views.ORBIT_PIXELS", 24)
    left, judged = held_back([], "jittered")
    assert (len(left), len(judged)) == (8, 16) and not poses(left) & poses(judged)


@pytest.mark.parametrize(("scale", "most"), [(1 / 4, WINDOW), (1, WINDOW), (4, WINDOW // 4), (WINDOW, 1)])
def test_a_window_bounds_what_is_judged(scale, most):
    views = tiny.cameras(width=3 * WINDOW, height=2 * WINDOW)
    _, judged = held_back(views, "given", scale)
    assert {view.size for view in judged} == {(most, most)}
    assert judged[0].fx == views[0].fx and judged[0].cx == pytest.approx(most / 2, abs=0.5)  # the middle


def test_where_one_pixel_of_the_base_is_more_than_is_judged_nothing_is():
    views = tiny.cameras()
    assert held_back(views, "given", 2 * WINDOW) == (views, [])


def test_a_seed_chooses_the_views():
    cameras = tiny.cameras(MANY)
    first, again, other = (held_back(cameras, "jittered", seed=seed)[1] for seed in (3, 3, 4))
    assert poses(first) == poses(again) != poses(other)


# Judging


def judge(truth, views=2):
    """A validation for which a "model" is the brightness of each view."""
    cameras = tiny.cameras(views)
    shown = lambda brightness, camera: torch.full((*camera.size, 3), brightness[[view.name for view in cameras].index(camera.name)])  # noqa: E731
    return Validation(cameras, cameras, 1.0, lambda view: torch.full((*view.size, 3), truth), shown, "area")


def shows(*brightness):
    return SimpleNamespace(gaussians=lambda camera: brightness, parameters=lambda: {"means": torch.zeros(1, 3)}, traits=Traits())


def test_decibels_are_the_mean_of_each_view_as_it_is_displayed():
    by_hand = (-10 * math.log10(0.1**2 + VISIBLE_ERROR) - 10 * math.log10(0.5**2 + VISIBLE_ERROR)) / 2  # 1.7 is displayed as 1
    assert judge(0.5).steer(shows(0.6, 1.7)) == pytest.approx(by_hand, abs=1e-4)


def test_what_nobody_sees_outweighs_nothing():
    """A view of a plain sky that falls from 90 dB to 60, beside one that rises from 20 to 30."""
    sky, better = (10 ** (-db / 20) for db in (90, 60))
    states = {"base": shows(sky, 0.1), "last": shows(better, 10**-1.5)}
    name, found = judge(0.0).choose(states)
    assert name == "last" and judge(0.0).steer(states["last"]) > judge(0.0).steer(states["base"]) + 4
    most = -10 * math.log10(INVISIBLE_ERROR)
    assert found == pytest.approx({"base": (most + 20) / 2, "last": (most + 30) / 2}, abs=1e-3)


def test_what_is_told_is_the_psnr_and_what_is_compared_what_can_be_seen():
    quality = judge(0.0).quality(shows(0.01, 0.01))
    assert quality.psnr == pytest.approx(40.0, abs=1e-3) and quality.visible == pytest.approx(-10 * math.log10(1e-4 + VISIBLE_ERROR), abs=1e-3)


def test_validation_views_are_as_typical_as_the_cameras():
    """One camera far from all others would have most of the views that fill gaps."""
    cameras = tiny.cameras(MANY)
    away = torch.eye(4, dtype=torch.float64)
    away[:3, 3] = 50.0
    cameras.append(replace(cameras[0], viewmat=away))
    _, judged = held_back(cameras, "jittered")
    assert sum(bool(view.center.norm() > 25) for view in judged) <= 2


def test_splats_that_are_the_same_for_all_views_are_activated_once():
    activated, model = [], tiny.model(2)
    model.gaussians = lambda camera: activated.append(camera) or (0.6, 1.7)
    judge(0.5).steer(model)
    assert len(activated) == 1


def test_the_best_state_is_chosen_and_every_score_is_told():
    states = {"base": shows(0.1, 0.1), "best": shows(0.01, 0.01), "last": shows(1.0, 1.0)}
    name, found = judge(0.0).choose(states)
    assert name == "best"
    assert found == pytest.approx({"base": 20.0, "best": 40.0, "last": 0.0}, abs=1e-3)


@pytest.mark.parametrize(("worse_db", "chosen"), [(0.0, "later"), (TIE_DB / 2, "later"), (2 * TIE_DB, "earlier")])
def test_of_equals_the_later_is_chosen(worse_db, chosen):
    later = 0.1 * 10 ** (worse_db / 20)
    assert judge(0.0).choose({"base": shows(0.3, 0.3), "earlier": shows(0.1, 0.1), "later": shows(later, later)})[0] == chosen


def test_none_that_is_worse_than_what_went_in_is_chosen():
    """Not even by so little that it counts as equal."""
    worse = 0.1 * 10 ** (TIE_DB / 2 / 20)
    assert judge(0.0).choose({"base": shows(0.1, 0.1), "later": shows(worse, worse)})[0] == "base"
    assert judge(0.0).choose({"base": shows(0.1, 0.1), "later": shows(0.1, 0.1)})[0] == "later"


def test_only_what_is_allowed_is_chosen_and_the_others_are_told_too():
    states = {"base": shows(0.01, 0.01), "start": shows(0.1, 0.1), "last": shows(0.2, 0.2)}
    name, found = judge(0.0).choose(states, ["start", "last"])
    assert name == "start" and found["base"] == pytest.approx(40.0, abs=1e-3)


# Steering


def steering(**more) -> Steering:
    return Steering(30.0, 30.0, Snapshot.of(tiny.model(2)), **more)


def test_boldness_rises_by_the_same_factor_in_each_step_of_the_warm_up():
    config = recipe("default", SCALE, steps=16, warm_up=0.5)
    risen = [steering().rate_factor(step, config) for step in (0, 2, 4, 6, 8, 12, 16)]
    assert risen == pytest.approx([FIRST_RATE_FACTOR, FIRST_RATE_FACTOR**0.75, FIRST_RATE_FACTOR**0.5, FIRST_RATE_FACTOR**0.25, 1, 1, 1])
    assert steering().rate_factor(0, recipe("default", SCALE, warm_up=0)) == 1


def test_boldness_does_not_rise_above_the_ceiling():
    config, capped = recipe("default", SCALE, steps=16, warm_up=0.5), steering(ceiling=0.25)
    assert [capped.rate_factor(step, config) for step in (0, 8, 16)] == pytest.approx([FIRST_RATE_FACTOR, 0.25, 0.25])


def test_harm_is_less_than_the_start_by_more_than_a_choice_of_views_makes():
    assert not steering().is_harmful(30 - HARM_DB + 1e-6)
    assert steering().is_harmful(30 - HARM_DB - 1e-6)


@pytest.mark.parametrize(("gained", "lost"), [(0.0, LOST_DB), (0.5, LOST_DB), (8.0, 8 * LOST_FRACTION)])
def test_while_rates_rise_harm_is_the_loss_of_much_that_was_gained(gained, lost):
    run, student = steering(), tiny.model(2, seed=1)
    run.update_best(30 + gained, 7, student)
    assert not run.is_harmful(30 + gained - lost + 1e-6, rising=True)
    assert run.is_harmful(30 + gained - lost - 1e-6, rising=True)
    assert run.is_harmful(30 + gained - lost - 1e-6) == (gained == 0)  # later only what is worse than the start


def test_what_is_taken_back_goes_on_with_gentler_steps():
    run = steering()
    run.reduce_rates(0.5)
    run.reduce_rates(run.ceiling)
    assert run.ceiling == 0.5 * RATE_REDUCTION**2


@pytest.mark.parametrize(("best_factor", "rising", "ceiling"), [(0.3, True, 0.3), (0.3, False, 0.4), (0.8, True, 0.4)])
def test_while_rates_rise_those_that_led_to_the_best_state_are_the_limit(best_factor, rising, ceiling):
    run = steering()
    run.update_best(31.0, 7, tiny.model(2, seed=1), rate_factor=best_factor)
    run.reduce_rates(0.8, rising=rising)
    assert run.ceiling == ceiling


@pytest.mark.parametrize(("rising", "ceilings"), [(True, [0.05, 0.1, 0.1, 0.2]), (False, [0.05] * 4)])
def test_a_limit_that_was_found_before_anything_was_gained_rises_with_what_is_gained(rising, ceilings):
    run, student, config = steering(), tiny.model(2, seed=1), recipe("default", SCALE, steps=16, warm_up=0.5)
    run.reduce_rates(0.1, rising=rising)
    found = [run.ceiling]
    for step, visible in enumerate((31.0, 30.9, 32.0), 9):
        assert run.is_rising(step, config) == rising
        run.update_best(visible, step, student, rate_factor=run.ceiling)
        found.append(run.ceiling)
    assert found == pytest.approx(ceilings)
    run.reduce_rates(run.ceiling, rising=rising)
    assert not run.is_rising(12, config)  # a limit that was found after a gain stays


@pytest.mark.parametrize(
    ("gained", "progress", "warm_up", "bold"),
    [(0.0, 0.25, 0.1, True), (0.2, 0.25, 0.1, True), (0.3, 0.25, 0.1, False), (0.0, 0.24, 0.1, False), (0.0, 0.25, 0.0, False)],
)
def test_where_limited_rates_hardly_gained_high_ones_are_tried_and_nothing_is_taken_back(gained, progress, warm_up, bold):
    run, config = steering(ceiling=0.1), recipe("default", SCALE, steps=16, warm_up=warm_up)
    run.update_best(30 + gained, 4, tiny.model(2, seed=1))
    run.dare(progress, config)
    assert (run.bold, run.ceiling) == (bold, 1.0 if bold else 0.1)
    assert run.is_harmful(10.0) != bold


def test_what_is_hardly_to_be_seen_may_be_much_of_what_is_left_of_the_error():
    run = Steering(41.5, 41.6, Snapshot.of(tiny.model(2)), ceiling=0.1)  # 50.3 dB without VISIBLE_ERROR, and 51.1
    run.dare(0.25, recipe("default", SCALE, steps=16))
    assert not run.bold


@pytest.mark.parametrize(("ceiling", "gathering"), [(1.0, 0.25), (0.5, 0.0)], ids=["nothing limits", "no new views come"])
def test_rates_that_had_no_time_to_gain_are_steered_on(ceiling, gathering):
    run = steering(ceiling=ceiling)
    run.dare(1.0, recipe("default", SCALE, gathering=gathering))
    assert not run.bold


@pytest.mark.parametrize("rows", [5, 3])
def test_what_is_taken_back_is_held_without_the_momentum_of_what_was_done_since(rows):
    student, other = tiny.model(5).copy(), tiny.model(rows, seed=1)
    optimizer = make_optimizer(student, recipe("default", 4, rates={"opacities": 0.1}), pixel=1.0)
    before, wanted = student.parameters()["opacities"], other.parameters()["opacities"]

    def step(gradient):
        student.parameters()["opacities"].grad = gradient * torch.ones_like(student.parameters()["opacities"])
        optimizer.step()

    for _ in range(3):
        step(-1.0)
    restore_snapshot(student, optimizer, Snapshot.of(other))
    assert same(other, student) and (student.parameters()["opacities"] is before) == (rows == 5)
    step(1.0)
    # The squares of the same rows are known, so that the step is that of the fourth of four equal gradients, three of them forgotten.
    share = (1 - optimizer.betas[0]) / (1 - optimizer.betas[0] ** 4) if rows == 5 else 1.0
    torch.testing.assert_close(student.parameters()["opacities"].detach(), wanted - 0.1 * share)


@pytest.mark.parametrize(("psnr", "best_db", "step"), [(31.0, 31.0, 7), (30 - TIE_DB / 2, 30.0, 7), (30 - 2 * TIE_DB, 30.0, 0)])
def test_a_state_is_kept_unless_it_is_worse(psnr, best_db, step):
    run, student = steering(), tiny.model(2, seed=1)
    run.update_best(psnr, 7, student)
    assert (run.best_db, run.best_step) == (best_db, step)
    assert torch.equal(run.best.rows["means"], student.parameters()["means"]) == (step == 7)


# Whole runs


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
    started, adapted = model.adapt(scale, **{**HARMFUL, "steps": 0}), model.adapt(scale, **HARMFUL)
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
    assert same(adapted.model, model.adapt(SCALE, **{**HARMFUL, "steps": 0}).model)


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
    monkeypatch.setattr(start, "ROUNDS", 0)  # there is no time to match blend weights
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
    assert [step for step in range(1, config.steps + 1) if loop.is_checked(step, config)] == checks
    assert [step for step in range(1, config.steps + 1) if loop.checks_until(config, step) > loop.checks_until(config, step - 1)] == checks


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
    return VanillaModel(tiny.model(40).parameters(), origin=Origin(extras={"confidence": np.arange(40, dtype=np.float32)}))


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
    monkeypatch.setattr(start.StartSearch, "best", lambda self: (tiny.model(40, seed=5), "another scene"))
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
