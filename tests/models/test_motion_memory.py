"""Fields of moving scenes are evaluated once for the splats and a moment, and while splats are adapted only once that matters."""

import copy
import json
import pickle
from dataclasses import replace
from types import SimpleNamespace

import moving
import pytest
import tiny
import torch

from mipmap_plugin.adaptation.optimization.following import Following, release
from mipmap_plugin.adaptation.start.search import StartSearch
from mipmap_plugin.adaptation.views.moments import at_moments, at_their_moments, evaluate_moments
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import Traits
from mipmap_plugin.models.moving import memory
from mipmap_plugin.models.moving.hexplane import HexPlane
from mipmap_plugin.models.moving.memory import Memory
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.recipes import recipe
from mipmap_plugin.scenes import load_scene
from mipmap_plugin.wrap import Interrupted, wrap_model

best = StartSearch.best  # not a wrapped one
ALL_ON = "no_do=False, no_dshs=False, static_mlp=True, apply_rotation=True"


def counted_memory(limit=1 << 30):
    asked = []

    def evaluate(means, time):
        asked.append((len(means), time))
        return {"means": means * time}

    return Memory(evaluate, limit), asked


def at_times(count):
    return [replace(view, time=number / (count - 1)) for number, view in enumerate(tiny.cameras(count))]


@pytest.mark.parametrize("write", [moving.write_deformable, moving.write_hexplane])
def test_rows_come_out_the_same_among_any_others(tmp_path, write):
    """What is kept of splats that a pruning leaves is what a resumed run evaluates anew; products of one to three rows are rounded otherwise."""
    field = load_model(write(tmp_path / "m")).field
    means = torch.randn(memory.CHUNK + 1, 3, generator=torch.Generator().manual_seed(0))
    whole, left = (Memory(field.changes)(some, 0.4) for some in (means, means[1:]))
    assert all(torch.equal(changes[1:], left[name]) for name, changes in whole.items())


@pytest.mark.parametrize("write", [moving.write_deformable, lambda folder: moving.write_hexplane(folder, ALL_ON)])
def test_what_is_kept_shows_what_an_evaluation_shows(tmp_path, write):
    model = load_model(write(tmp_path / "m"))
    for _ in range(2):
        known, exact = model.gaussians(moving.at(0.4)), moving.moved_to(model.field, model.canonical, 0.4)
        for name in ("means", "scales", "quats", "opacities", "sh"):
            assert torch.equal(getattr(known, name), getattr(exact, name))


def test_a_moment_is_evaluated_once_for_a_model_and_its_copies_and_again_where_splats_moved(tmp_path, monkeypatch):
    model, evaluated = load_model(moving.write_hexplane(tmp_path / "m")), []
    changes = model.field.changes
    monkeypatch.setattr(model._memory, "_evaluate", lambda means, time: evaluated.append(time) or changes(means, time))
    student = model.copy()
    for each in (model, student, model):
        each.gaussians(moving.at(0.5))
    assert evaluated == [0.5]
    with torch.no_grad():
        student.parameters()["means"][3] += 0.1
    assert not torch.equal(student.gaussians(moving.at(0.5)).means[3], model.gaussians(moving.at(0.5)).means[3])
    assert torch.equal(student.gaussians(moving.at(0.5)).means, moving.moved_to(model.field, student.canonical, 0.5).means)
    assert evaluated == [0.5, 0.5]  # what was known of the base still is


@pytest.mark.parametrize("options", ["", ALL_ON])
def test_the_gradient_of_a_mean_goes_through_a_hexplane_as_in_the_original(tmp_path, options):
    model = load_model(moving.write_hexplane(tmp_path / "m", options)).copy()
    means, weights = model.parameters()["means"], torch.linspace(-1, 1, 180).reshape(60, 3)
    [ours] = torch.autograd.grad((model.gaussians(moving.at(0.3)).means * weights).sum(), means)
    changes = HexPlane.changes.__wrapped__(model.field, means, 0.3)  # with a gradient
    [exact] = torch.autograd.grad((model.field.moved(model.canonical, changes).means * weights).sum(), means)
    torch.testing.assert_close(ours, exact, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(ours, weights, rtol=1e-2)


def test_a_followed_hexplane_moves_splats_along_its_slopes(tmp_path):
    model = load_model(moving.write_hexplane(tmp_path / "m")).copy()
    model.follow(reach=1.0)
    with torch.no_grad():
        model.parameters()["means"].add_(1e-3)
    known, exact = model.gaussians(moving.at(0.4)).means, moving.moved_to(model.field, model.canonical, 0.4).means
    stale = model.field.moved(model.canonical, model.field.changes(model.held, 0.4)).means
    assert float((known - exact).abs().mean()) < float((stale - exact).abs().mean()) / 3


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))])
def test_a_model_can_be_copied_by_python_and_sent_to_other_processes(tmp_path, copied):
    model = load_model(moving.write_hexplane(tmp_path / "m"))
    before = model.gaussians(moving.at(0.5)).means
    assert torch.equal(copied(model).gaussians(moving.at(0.5)).means, before)


MOMENT = 10 * 3 * 4  # bytes of ten splats


def test_moments_that_come_in_turn_are_not_all_forgotten():
    """Forgetting what was of use longest ago would evaluate each of them anew in each turn."""
    known, asked = counted_memory(limit=3 * MOMENT)
    means = torch.ones(10, 3)
    for time in 3 * [0.1, 0.2, 0.3, 0.4]:
        assert torch.equal(known(means, time)["means"], means * time)
    assert [time for _, time in asked] == [0.1, 0.2, 0.3, 0.4, 0.4, 0.4]


def test_what_is_of_no_use_makes_room_before_what_is_the_bases():
    known, asked = counted_memory(limit=3 * MOMENT)
    base, before, now = (torch.full((10, 3), number) for number in (1.0, 2.0, 3.0))
    for means, time in ((base, 0.1), (before, 0.1), (before, 0.2), (now, 0.3), (now, 0.2)):
        known(means, time)
    asked.clear()
    for means, time in ((base, 0.1), (now, 0.2), (now, 0.3)):
        known(means, time)
    assert asked == []
    known(now, 0.1)  # the base's makes room now
    known(now, 0.1)
    assert len(asked) == 1 and not known.knows(base, 0.1)
    known(base, 0.1)
    assert all(known.knows(now, time) for time in (0.1, 0.2, 0.3))


def test_moments_share_the_means_that_they_were_evaluated_at():
    known, _ = counted_memory()
    for time in (0.1, 0.2, 0.3):
        known(torch.ones(10, 3), time)
        known(2 * torch.ones(10, 3), time)
    assert len({place.data_ptr() for place, _ in known._known.values()}) == 2


def test_splats_that_moved_in_place_are_evaluated_anew():
    """As an optimizer moves them."""
    known, _ = counted_memory()
    means = torch.ones(10, 3)
    for _ in range(3):  # as the base's, and as others
        assert torch.equal(known(means, 0.5)["means"], means / 2)
        means += 1


def test_many_splats_are_evaluated_in_parts(monkeypatch):
    monkeypatch.setattr(memory, "CHUNK", 4)
    known, asked = counted_memory()
    means = torch.arange(30.0).reshape(10, 3)
    assert torch.equal(known(means, 0.5)["means"], means / 2) and [count for count, _ in asked] == [4, 3, 3]


def test_a_followed_model_moves_its_splats_as_before_until_they_are_far_off(tmp_path):
    model = load_model(moving.write_deformable(tmp_path / "m"))
    student, camera = model.copy(), moving.at(0.7)
    student.follow(reach=0.1)
    before = student.gaussians(camera).means - student.parameters()["means"]
    with torch.no_grad():
        student.parameters()["means"].add_(0.05)
    student.follow(reach=0.1)
    torch.testing.assert_close(student.gaussians(camera).means - student.parameters()["means"], before)
    with torch.no_grad():
        student.parameters()["means"].add_(0.05)
    student.follow(reach=0.1)
    assert torch.equal(student.gaussians(camera).means, moving.moved_to(model.field, student.canonical, 0.7).means)
    with torch.no_grad():
        student.parameters()["means"].add_(0.01)
    release(student)
    assert torch.equal(student.gaussians(camera).means, moving.moved_to(model.field, student.canonical, 0.7).means)


def test_more_than_a_tenth_of_the_splats_have_to_move_far(tmp_path):
    student = load_model(moving.write_deformable(tmp_path / "m")).copy()
    student.follow(reach=0.1)
    before = student.held.clone()
    for far, followed in ((6, False), (7, True)):  # of 60
        with torch.no_grad():
            student.parameters()["means"][:far] += 1
        student.follow(reach=0.1)
        assert torch.equal(student.held, before) != followed


def test_rows_that_are_left_move_as_before_without_an_evaluation(tmp_path, monkeypatch):
    model = load_model(moving.write_deformable(tmp_path / "m"))
    student, camera, rows = model.copy(), moving.at(0.2), torch.arange(0, 60, 3)
    student.follow(reach=0.1)
    before = student.gaussians(camera).means[rows]
    student.keep_motions(rows)
    student.replace_parameters({name: tensor.detach()[rows].requires_grad_() for name, tensor in student.parameters().items()})
    monkeypatch.setattr(model._memory, "_evaluate", None)
    assert torch.equal(student.gaussians(camera).means, before)


def test_no_copy_of_plain_splats_is_made_when_some_are_dropped(monkeypatch):
    """Nothing moves, so that nobody has to be told which rows are left."""
    copies = []
    monkeypatch.setattr(VanillaModel, "keep_rows", lambda model, keep: copies.append(len(keep)))
    adapted = wrap_model(tiny.model(), cameras=tiny.cameras()).adapt(
        1 / 4, steps=4, extra_views=0, merge_to=1.0, closed_form=False, prune_every=2, min_opacity=0.4, returns="last"
    )
    assert 0 < len(adapted.model.parameters()["means"]) < 60 and copies == []


def test_other_rows_are_evaluated_anew(tmp_path):
    student = load_model(moving.write_deformable(tmp_path / "m")).copy()
    student.follow(reach=0.1)
    student.replace_parameters({name: tensor.detach()[:7].clone().requires_grad_() for name, tensor in student.parameters().items()})
    assert len(student.gaussians(moving.at(0.2))) == 7


def test_a_slope_is_that_of_places_at_the_distance():
    known, _ = counted_memory()  # which moves splats by 0, 1/4, ... 1 of their places
    assert known.slope(torch.ones(10, 3), 0.3) == pytest.approx((1.875 / 5) ** 0.5)


def test_the_reach_is_shorter_where_neighbors_move_otherwise(tmp_path):
    rough, state = moving.deform_state(), moving.deform_state()
    for name in ("linear.0.weight", "linear.5.weight"):
        state[name][:, 9:63] = 0  # none but the slowest waves
    smooth = load_model(moving.write_deformable(tmp_path / "s", state)).reach(0.01)
    assert load_model(moving.write_deformable(tmp_path / "r", rough)).reach(0.01) < smooth / 3 and smooth <= 0.01


def test_views_are_at_the_nearest_of_few_moments():
    views = at_times(11)
    assert [view.time for view in at_moments(views, 3)] == [0] * 3 + [0.5] * 5 + [1] * 3
    assert at_moments(views, None) == views == at_moments(views, 11)
    assert [view.viewmat.tolist() for view in at_moments(views, 2)] == [view.viewmat.tolist() for view in views]


def test_views_that_choose_have_moments_of_their_own():
    views, validation = at_times(30), [replace(view, time=0.01 + 0.03 * number) for number, view in enumerate(tiny.cameras(24))]
    used, both, note = at_their_moments(views, validation, 6, seed=0)
    moments = {view.time for view in used}
    assert len(moments) <= 6 and {view.time for view in both[::2]} <= moments and note == "at their own times, each at the nearest of 6 moments"
    own = {view.time for view in both[1::2]}
    assert len(own) <= 6 and own <= {view.time for view in validation[1::2]}
    assert at_their_moments(views, validation, None, seed=0)[::2] == (views, "at their own times")


def test_the_published_recipe_takes_each_view_at_its_own_time():
    assert recipe("paper", 1 / 4).moments is None and recipe("default", 1 / 4).moments == recipe("default", 4).moments == 24


def test_a_run_evaluates_the_field_a_few_times_a_moment_whatever_its_views(tmp_path, monkeypatch):
    evaluated, changes = [], HexPlane.changes
    monkeypatch.setattr(HexPlane, "changes", lambda field, means, time: evaluated.append(len(means)) or changes(field, means, time))
    cameras = at_times(30)
    wrapped = wrap_model(moving.write_hexplane(tmp_path / "m"), cameras=cameras)
    adapted = wrapped.adapt(1 / 2, steps=40, extra_views=10, moments=4, validation_views=4)
    assert sum(evaluated) / 60 < 60  # of 160 pictures of steps, and 50 others
    assert adapted.report.views.endswith("at their own times, each at the nearest of 4 moments")
    assert adapted.model.held is None


def test_the_bases_moments_are_evaluated_in_a_phase_of_their_own(tmp_path, monkeypatch):
    """A truth costs no evaluation, so that the time left follows from what truths and steps cost."""
    wrapped = wrap_model(moving.write_hexplane(tmp_path / "m"), cameras=at_times(9))
    evaluated, changes = [], HexPlane.changes
    monkeypatch.setattr(HexPlane, "changes", lambda field, means, time: evaluated.append(time) or changes(field, means, time))
    ahead = []
    monkeypatch.setattr(StartSearch, "best", lambda search: ahead.append(len(evaluated)) or best(search))
    adapted = wrapped.adapt(1 / 2, recipe="instant", extra_views=0, moments=5, validation_views=4)
    assert adapted.report.seconds["motion"] > 0 and len(set(evaluated[: ahead[0]])) >= 5
    static = wrap_model(tiny.model(), cameras=tiny.cameras()).adapt(1 / 2, recipe="instant")
    assert "motion" not in static.report.seconds


def test_a_moving_model_without_a_memory_is_not_evaluated_ahead():
    """As one of a third party: nothing of it would be kept."""
    base = SimpleNamespace(traits=Traits(moves=True), gaussians=None)
    evaluate_moments(base, at_times(3), phase=None)
    Following(base, at_times(3), 0.5)(base)


def test_photographs_stay_at_their_own_moments(tmp_path):
    """They show no other one."""
    train = [replace(view, time=number / 5) for number, view in enumerate(tiny.cameras(6))]
    folder = tiny.scene(tmp_path / "scene", train=train, seed=5)
    path = folder / "transforms_train.json"
    timed = [{**frame, "time": view.time} for frame, view in zip(json.loads(path.read_text())["frames"], train, strict=True)]
    path.write_text(json.dumps({"frames": timed}))
    wrapped = wrap_model(moving.write_hexplane(tmp_path / "m"), cameras=train)
    adapted = wrapped.adapt(2, images=load_scene(folder), steps=1, extra_views=1, moments=2)
    assert adapted.report.views.endswith("at their own times, 6 of them real images")
    assert [view.time for view in adapted.adapted_to[:6]] == [view.time for view in train]


def test_a_resumed_run_comes_to_the_same(tmp_path):
    """What it evaluates the field at is part of its state."""
    folder, settings = moving.write_hexplane(tmp_path / "m"), dict(steps=12, extra_views=2, validation_views=4, returns="last", prune_every=5)
    whole = wrap_model(folder).adapt(1 / 2, **settings).model.parameters()

    def interrupt(step, seconds, render):
        if step == 8:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted):
        wrap_model(folder).adapt(1 / 2, resume=tmp_path / "state", observe=interrupt, **settings)
    resumed = wrap_model(folder).adapt(1 / 2, resume=tmp_path / "state", **settings).model.parameters()
    assert all(torch.equal(resumed[name], tensor) for name, tensor in whole.items())
