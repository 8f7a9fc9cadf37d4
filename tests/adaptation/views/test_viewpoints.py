"""From where a scene without cameras is looked at: of a capture by those views of its orbit that see it clearly."""

import gc
import math
import pickle
import weakref
from dataclasses import replace

import pytest
import tiny
import torch
from lone_capture import capture

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.optimization.amount import DRAWS_A_SECOND, FOR_LOOKS, looks_in_budget
from mipmap_plugin.adaptation.views.for_validation import split_validation
from mipmap_plugin.adaptation.views.policy import choose_views
from mipmap_plugin.adaptation.views.viewpoints import FOG, LEAST_LOOKS, TRIED, ClearViews, Viewpoints
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.evaluation.measure import adapt_alone
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.recipes import recipe
from mipmap_plugin.scenes.orbits import EVERY, TURN, Orbit

CAPTURE, OBJECT = Orbit((0.0, 0.0, 0.0), (0.0, -1.0, 0.0), 8.0, nearest=4.0), Orbit((0.0, 0.0, 0.0), None, 8.0)
COUNT = 12


def views_of(orbit, clear, count=COUNT, beside=False):
    viewpoints = Viewpoints(orbit, lambda views: [view for view in views if clear(view)], beside=beside)
    return viewpoints.views((32, 32), count, torch.Generator().manual_seed(0))


def on_one_side(view):
    return float(view.center[0]) > 0


def test_views_of_a_capture_are_clear_and_as_many_as_are_wanted():
    views = views_of(CAPTURE, on_one_side)
    assert len(views) == COUNT and all(map(on_one_side, views))
    assert len({view.name for view in views}) == COUNT


def test_half_of_the_views_in_place_of_unclear_ones_look_beside_the_middle():
    """Of a room that is clear from one side, what lies beside its middle is in few views: a kitchen at x1/4 lost 7.6 dB in one that looked there."""
    first, others = [], []
    for view in views_of(CAPTURE, on_one_side, 80, beside=True):
        (others if int(view.name.removeprefix("orbit_")) >= 80 else first).append(turned(view))
    assert len(others) > 20 and max(map(abs, first)) < 1e-6
    aside = [turn for turn in others if abs(turn) > 1e-6]
    assert 0.3 < len(aside) / len(others) < 0.7 and all(TURN / 2 - 1e-6 < abs(turn) < TURN + 1e-6 for turn in aside)
    assert min(aside) < 0 < max(aside)  # to the right and to the left


@pytest.mark.parametrize(("orbit", "clear"), [(CAPTURE, lambda _: True), (replace(CAPTURE, seen="f" * 64, focal=32.0), on_one_side)])
def test_where_all_views_are_clear_or_colors_tell_of_photographs_all_look_at_the_middle(orbit, clear):
    assert max(abs(turned(view)) for view in views_of(orbit, clear, 80, beside=True)) < 1e-6


def turned(view, middle=torch.zeros(3, dtype=torch.float64)):  # noqa: B008
    """By which angle, radians, the middle of a capture lies beside what a view looks at: above 0 to the right."""
    x, y, z = view.to_camera(middle[None])[0].tolist()
    return math.copysign(math.atan2(math.hypot(x, y), z), x)


def test_where_few_are_clear_there_are_few_and_where_none_is_there_are_all():
    tried = []
    [found] = views_of(CAPTURE, lambda view: tried.append(view.name) or view.name == f"orbit_{2 * COUNT:04d}")
    assert found.name in tried and len(set(tried)) == math.ceil(TRIED / COUNT) * COUNT
    with pytest.warns(UserWarning, match="no generated view that was looked at sees this capture clearly"):
        assert len(views_of(CAPTURE, lambda view: False)) == COUNT


def test_of_few_views_two_are_looked_for_longer():
    """One to steer by, and one to choose by: of the first 24 views that validation with six would try only one is clear."""
    tried = []
    found = views_of(CAPTURE, lambda view: tried.append(view.name) or int(view.name.removeprefix("orbit_")) in (3, 50, 51, 90), count=6)
    assert [view.name for view in found] == ["orbit_0003", "orbit_0050", "orbit_0051"] and len(set(tried)) == 54


def looked_at(share, count, looks=float("inf")):
    """How many views are looked at of which so large a share is clear, and how many are found."""
    tried = []

    def clear(views):
        tried.extend(views)
        return views[: round(share * len(views))]

    found = Viewpoints(CAPTURE, clear, looks).views((8, 8), count, torch.Generator().manual_seed(0))
    return len(tried), len(found)


def test_not_many_more_are_looked_at_than_are_wanted():
    assert looked_at(0.8, 100) == (125, 100)


@pytest.mark.parametrize(("looks", "expected"), [(40.5, (40, 20)), (110, (110, 55)), (500, (200, 100))])
def test_a_budget_bounds_how_many_are_looked_at(looks, expected):
    assert looked_at(0.5, 100, looks) == expected


def test_where_a_budget_allows_hardly_any_look_any_view_is_taken_and_a_line_says_so():
    with pytest.warns(UserWarning, match="no time to look for views that see this capture clearly"):
        assert looked_at(0.5, 100, LEAST_LOOKS - 1) == (0, 100)
    assert looked_at(1.0, 4, LEAST_LOOKS - 1) == (4, 4)


def test_looks_follow_from_the_budget_and_the_splats():
    model = tiny.model(50)
    assert looks_in_budget(AdaptConfig(), model) == float("inf")
    assert looks_in_budget(AdaptConfig(time_budget_s=2.0), model) == FOR_LOOKS * 2.0 * DRAWS_A_SECOND / 50


def test_an_object_is_looked_at_from_all_around():
    assert len(views_of(OBJECT, lambda view: False)) == COUNT


def scene(*, floater):
    """A square of 400 small splats at z = 0, and a large one at z = -2."""
    places = torch.linspace(-1, 1, 20)
    square = torch.stack([*torch.meshgrid(places, places, indexing="ij"), torch.zeros(20, 20)], dim=-1).reshape(-1, 3)
    splats = tiny.gaussians(401)
    means, scales = torch.cat([square, torch.tensor([[0.0, 0.0, -2.0]])]), torch.full((401, 3), 0.04)
    scales[-1] = floater
    return replace(splats, means=means, scales=scales, opacities=torch.full((401,), 0.95))


def looking(z: float) -> Camera:
    """From (0, 0, z) at the square; z < 0 along +z."""
    turn = torch.diag(torch.tensor([1.0, 1.0, 1.0] if z < 0 else [-1.0, 1.0, -1.0]))
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[2, 3] = turn, abs(z)
    return Camera(200, 200, 200.0, 200.0, 100.0, 100.0, viewmat, f"from {z:g}")


def clear_views(splats, views):
    wrapped = wrap_model(VanillaModel.from_gaussians(splats), backend="reference")
    return [view.name for view in wrapped.viewpoints.clear(views)]


@pytest.mark.parametrize(("floater", "seen"), [(1.0, ["from 4"]), (0.04, ["from -4", "from 4"])])
def test_a_view_through_a_large_splat_is_not_clear_and_what_is_behind_the_scene_does_not_count(floater, seen):
    assert clear_views(scene(floater=floater), [looking(-4.0), looking(4.0)]) == seen


def test_how_large_a_splat_may_look_is_a_share_of_the_picture():
    near, far = (clear_views(scene(floater=0.04), [looking(-z)]) for z in (2.3, 0.9 * 0.04 / FOG))
    assert near and not far  # from where the square's splats are larger than that


def test_a_view_of_nothing_is_not_clear():
    away = replace(looking(-4.0), viewmat=torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ looking(-4.0).viewmat.float())
    assert clear_views(scene(floater=0.04), [away]) == []


def test_each_view_is_looked_at_once():
    wrapped, asked = wrap_model(VanillaModel.from_gaussians(scene(floater=0.04)), backend="reference"), []
    clear = ClearViews(wrapped.model, lambda: asked.append(1) or wrapped.backend(), wrapped.effects())
    assert len(clear([looking(-4.0)])) == len(clear([looking(-4.0)])) == len(asked) == 1


def lone_capture():
    """A capture without cameras."""
    splats = scene(floater=0.04)
    far = torch.cat([splats.means[:-60], 40 * torch.randn(60, 3, generator=torch.Generator().manual_seed(0))])
    return wrap_model(VanillaModel.from_gaussians(replace(splats, means=far)))


@pytest.mark.filterwarnings("ignore:no cameras are known")
def test_views_beside_the_middle_are_adapted_to_and_no_others(monkeypatch):
    """In validation, or as the base's own, they would show more of what viewers leave out than users see."""
    lone, validated = lone_capture(), []
    middle = torch.tensor(lone.viewpoints.orbit.center, dtype=torch.float64)
    monkeypatch.setattr(ClearViews, "__call__", lambda _, views: [view for view in views if on_one_side(view)])
    split = "mipmap_plugin.adaptation.views.of_run.split_validation"
    monkeypatch.setattr(split, lambda *given: validated.append(split_validation(*given)) or validated[-1])
    lone.adapt(1 / 4, recipe="instant", extra_views=20)
    [(adapted, validation)] = validated
    turns = [[abs(turned(view, middle)) for view in views] for views in (adapted, validation, lone.views())]
    assert len(validation) > 1 and [max(each) > TURN / 2 - 1e-3 for each in turns] == [True, False, False]


@pytest.mark.filterwarnings("ignore:no ")
def test_views_that_are_adapted_to_are_finer_but_not_those_that_stand_for_the_training(monkeypatch):
    """From those follow the distances of a ladder."""
    monkeypatch.setattr("mipmap_plugin.adaptation.views.policy.ORBIT_PIXELS", 200)  # a finer view of fewer shows little but a splat or two
    lone = wrap_model(VanillaModel.from_gaussians(capture().to(dtype=torch.float32)))
    details = [{round(view.fx / 10) for view in views} for views in (lone.views(), lone.adapt(1 / 4, recipe="instant", extra_views=20).adapted_to)]
    assert [len(each) for each in details] == [2, 4]  # from near and from far


def are_finer(views):
    """Of each view of `CAPTURE`, with a focal length of 10 px from 4 units away, whether it is finer."""
    return [view.fx > 1.5 * 10 * float(view.center.norm()) / 4 for view in views]


@pytest.mark.parametrize(("name", "count"), [("instant", 1), ("default", 2)])
def test_whatever_is_clear_as_many_of_the_views_that_choose_are_finer_as_of_those_that_steer(name, count):
    """A fifth of those that are adapted to, and about as many of each half of the views for validation."""
    config, somewhere = recipe(name, 1 / 4), Viewpoints(replace(CAPTURE, focal=10.0), lambda views: [view for view in views if on_one_side(view)])
    views, _ = choose_views([], somewhere, config)
    adapted, validation = split_validation([], views, somewhere, 1 / 4, config)
    assert sum(are_finer(adapted)) == len(adapted) / EVERY
    assert [sum(are_finer(half)) for half in (validation[::2], validation[1::2])] == [count, count]


@pytest.mark.parametrize(("looks", "finer"), [(math.inf, 0), (COUNT, 2)])
def test_a_finer_view_that_is_not_clear_is_not_taken_and_a_budget_is_not_spent_on_looking(looks, finer):
    orbit = replace(CAPTURE, focal=10.0)
    somewhere = Viewpoints(orbit, lambda views: [view for view, fine in zip(views, are_finer(views), strict=True) if not fine], looks)
    assert sum(are_finer(somewhere.views((32, 32), COUNT, torch.Generator().manual_seed(0)))) == finer


@pytest.mark.filterwarnings("ignore:no cameras are known")
def test_choosing_views_takes_a_phase_of_its_own():
    lone = lone_capture()
    report = lone.adapt(1 / 4, recipe="instant", extra_views=2).report
    assert lone.viewpoints.orbit.nearest and 0 < report.seconds["views"] < report.seconds["total"]
    assert "views" not in lone.adapt(1 / 4, recipe="instant", cameras=tiny.cameras(2)).report.seconds
    seconds = lone.adapt(1, recipe="instant", extra_views=2).report.seconds
    assert 0 < seconds["compilation"] + seconds["views"] == pytest.approx(seconds["total"])  # at scale 1 nothing else is done


@pytest.mark.filterwarnings("ignore:no cameras are known")
def test_a_base_that_looked_for_clear_views_is_freed_at_once_and_can_be_pickled():
    lone = wrap_model(VanillaModel.from_gaussians(scene(floater=0.04)), backend="reference")
    assert lone.viewpoints.clear([looking(-4.0)])
    again = pickle.loads(pickle.dumps(lone))
    assert again.viewpoints.orbit == lone.viewpoints.orbit and len(again.viewpoints.clear([looking(4.0)])) == 1
    gc.disable()
    try:
        known = weakref.ref(lone)
        del lone
        assert known() is None
    finally:
        gc.enable()


def test_a_model_is_looked_at_with_the_detail_that_its_views_show(monkeypatch):
    wrapped, zooms = wrap_model(VanillaModel.from_gaussians(scene(floater=0.04)), backend="reference"), []
    clear, splats = wrapped.viewpoints.clear, wrapped.model.gaussians(looking(-4.0))
    monkeypatch.setattr(wrapped.model, "traits", replace(wrapped.model.traits, same_for_all_views=False), raising=False)
    monkeypatch.setattr(wrapped.model, "gaussians", lambda view: zooms.append(view.zoom) or splats)
    assert clear([looking(-4.0)]) and zooms == [1]


@pytest.mark.filterwarnings("ignore:no cameras are known")
def test_where_the_time_is_measured_views_are_looked_at_again(monkeypatch):
    looked, is_clear = [], ClearViews._is_clear
    monkeypatch.setattr(ClearViews, "_is_clear", lambda self, view, *rest: looked.append(view.name) or is_clear(self, view, *rest))
    lone = lone_capture()
    for _ in range(2):
        adapt_alone(lone, 1 / 4, recipe="instant", extra_views=2)
    assert len(looked) > 0 and looked[: len(looked) // 2] == looked[len(looked) // 2 :]
