"""Which views judge a model, and how it is judged."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import tiny
import torch
from equal_models import SCALE

from mipmap_plugin.adaptation.curve import INVISIBLE_ERROR
from mipmap_plugin.adaptation.optimization.validation import TIE_DB, VISIBLE_ERROR, Validation
from mipmap_plugin.adaptation.views.for_validation import VALIDATION_EVERY, WINDOW, split_validation
from mipmap_plugin.adaptation.views.policy import choose_views
from mipmap_plugin.adaptation.views.viewpoints import Viewpoints
from mipmap_plugin.models.base import Traits
from mipmap_plugin.recipes import recipe
from mipmap_plugin.scenes.orbits import Orbit

VIEWPOINTS = Viewpoints(Orbit.around(tiny.gaussians().means), list)

MANY = 2 * VALIDATION_EVERY  # cameras, of which two are kept back


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


def test_without_cameras_validation_has_an_orbit_of_its_own():
    left, judged = held_back([], "jittered")
    assert (len(left), len(judged)) == (8, 16) and not poses(left) & poses(judged)


@pytest.mark.parametrize(("scale", "most"), [(1 / 4, WINDOW), (1, WINDOW), (4, WINDOW // 4), (WINDOW, 1)])
def test_a_window_bounds_what_is_judged(scale, most):
    views = tiny.cameras(width=3 * WINDOW, height=2 * WINDOW)
    _, judged = held_back(views, "given", scale)
    assert {view.size for view in judged} == {(most, most)}
    assert judged[0].fx == views[0].fx and judged[0].cx == pytest.approx(most / 2, abs=0.5)  # the middle


@pytest.mark.parametrize("pixels", [3, 5, 7, 10, 1000])
def test_a_window_has_whole_blocks_where_its_view_has(pixels):
    """The filter `box` shrinks nothing else."""
    views = tiny.cameras(width=2000 * pixels, height=1500 * pixels)
    _, judged = held_back(views, "given", 1 / pixels)
    assert judged and all(side <= WINDOW for view in judged for side in view.size)
    assert all(side % small == 0 for view in judged for side, small in zip(view.size, view.zoomed(1 / pixels).size, strict=True))


def test_a_single_view_both_steers_and_chooses(monkeypatch):
    """Where only one view sees a scene clearly, what is no better than the base in it is still not returned."""
    monkeypatch.setattr("mipmap_plugin.adaptation.views.of_run.split_validation", lambda cameras, views, *others: (list(views), tiny.cameras(1)))
    report = tiny.wrapped(tiny.gaussians()).adapt(SCALE, cameras=tiny.cameras(4), steps=1).report
    assert "the base as it is" in report.validation and "not validated" not in report.returned


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
    return Validation(cameras, cameras, 1.0, lambda view: torch.full((*view.size, 3), truth), [shown], "area")


def shows(*brightness):
    return SimpleNamespace(gaussians=lambda camera: brightness, parameters=lambda: {"means": torch.zeros(1, 3)}, traits=Traits())


def test_decibels_are_the_mean_of_each_view_as_it_is_displayed():
    by_hand = (-10 * math.log10(0.1**2 + VISIBLE_ERROR) - 10 * math.log10(0.5**2 + VISIBLE_ERROR)) / 2  # 1.7 is displayed as 1
    assert judge(0.5).steer(shows(0.6, 1.7)) == pytest.approx(by_hand, abs=1e-4)


def test_a_truth_brighter_than_white_is_displayed_as_white():
    """So a bicubic filter makes it beside edges."""
    assert judge(1.1).quality(shows(1.1, 1.0)) == judge(1.0).quality(shows(1.0, 1.0))


def test_what_nobody_sees_outweighs_nothing():
    """A view of a plain sky that falls from 90 dB to 60, beside one that rises from 20 to 30."""
    sky, better = (10 ** (-db / 20) for db in (90, 60))
    states = {"base": shows(sky, 0.1), "last": shows(better, 10**-1.5)}
    name, found, *_ = judge(0.0).choose(states)
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
    name, found, *_ = judge(0.0).choose(states)
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
    name, found, *_ = judge(0.0).choose(states, ["start", "last"])
    assert name == "start" and found["base"] == pytest.approx(40.0, abs=1e-3)


def test_states_are_told_view_by_view_and_viewer_by_viewer_as_far_as_differences_are_seen():
    _, _, by_view, by_viewer = judge(0.0).choose({"base": shows(0.1, 0.0)})
    views = [-10 * math.log10(0.1**2 + VISIBLE_ERROR), -10 * math.log10(VISIBLE_ERROR)]
    assert by_view["base"] == pytest.approx(views, abs=1e-4) and by_viewer["base"] == pytest.approx([sum(views) / 2], abs=1e-4)
