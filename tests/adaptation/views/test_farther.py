"""Views from farther back than a capture was photographed from."""

import math

import pytest
import tiny
import torch
from levels_by_distance import from_x, with_background

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.views.farther import FARTHER_EVERY, FARTHEST, backed, foreground, some_farther, stepping_back
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.scenes.trajectories import jittered

NEAR = 0.2


def test_walking_back_moves_everything_away():
    view, points = tiny.cameras(1)[0], tiny.gaussians().means
    before, after = (camera.to_camera(points)[:, 2] for camera in (view, backed(view, 3.0)))
    torch.testing.assert_close(after, before + 3.0, rtol=1e-4, atol=1e-4)


def test_the_foreground_is_what_is_nearest_in_the_picture():
    view, splats = tiny.cameras(1)[0], with_background()
    depth = foreground(view, splats.means, 0.2)
    assert 0.2 < depth < 10
    assert foreground(backed(view, 5.0), splats.means, 0.2) > depth
    assert foreground(view, view.center.float()[None] - 100 * view.viewmat[2, :3].float()[None], 0.2) == math.inf


def test_views_step_back_by_up_to_the_smallest_scale():
    """Evenly in the logarithm; the direction and what else a camera is stay, and so does a view that sees nothing."""
    means, views, blind = with_background().means, tiny.cameras(8), from_x(1e6)
    farther = stepping_back([*views, blind], means, NEAR, 1 / 4)
    ways = [float(after.viewmat[2, 3] - before.viewmat[2, 3]) for before, after in zip(views, farther, strict=False)]
    scales = [depth / (depth + way) for depth, way in zip((foreground(view, means, NEAR) for view in views), ways, strict=True)]
    assert all(1 / 4 < scale < 1 for scale in scales) and max(scales) > 2 * min(scales)
    assert all(torch.equal(after.viewmat[:2], before.viewmat[:2]) for before, after in zip(views, farther, strict=False))
    assert farther[-1] is blind


def test_some_of_many_splats_tell_how_far_views_step_back(monkeypatch):
    means, views = with_background(near=3000, far=2000).means, tiny.cameras(8)
    whole = stepping_back(views, means, NEAR, 1 / 4)
    monkeypatch.setattr("mipmap_plugin.adaptation.views.farther.TELLING", 500)
    assert not torch.equal(stepping_back(views[:1], means, NEAR, 1 / 4)[0].viewmat, whole[0].viewmat)
    for view, one, other in zip(views, whole, stepping_back(views, means, NEAR, 1 / 4), strict=True):
        ways = [float((each.viewmat - view.viewmat)[2, 3]) for each in (one, other)]
        assert ways[1] == pytest.approx(ways[0], rel=0.1)


def test_some_generated_views_of_an_unbounded_scene_step_back():
    means, given = with_background().means, tiny.cameras(8)
    generated = jittered(given, 9, torch.Generator().manual_seed(0))
    views, told = some_farther([*given, *generated], given, means, NEAR, 1.0, None)
    moved = [number for number, (before, after) in enumerate(zip([*given, *generated], views, strict=True)) if before is not after]
    assert moved == [*range(8, 17, FARTHER_EVERY)] and told == ", 3 of these from farther back"
    depths = [foreground(view, means, NEAR) for view in (generated[0], views[8])]
    assert FARTHEST < depths[0] / depths[1] < 1


@pytest.mark.parametrize(
    ("means", "scale", "farthest", "moved"),
    [
        (tiny.gaussians(200).means, 1.0, None, 0),
        (tiny.gaussians(200).means, 1.0, 0.7, 3),
        (with_background().means, 1.0, 1.0, 0),
        (with_background().means, 0.5, None, 0),
        (with_background().means, 0.5, 0.7, 3),
    ],
)
def test_views_of_objects_and_of_zoom_outs_step_back_only_where_the_settings_say_so(means, scale, farthest, moved):
    given = tiny.cameras(8)
    views = [*given, *jittered(given, 9, torch.Generator().manual_seed(0))]
    found, told = some_farther(views, given, means, NEAR, scale, farthest)
    assert sum(before is not after for before, after in zip(views, found, strict=True)) == moved
    assert told == (f", {moved} of these from farther back" if moved else "")


def test_an_orbit_steps_back_only_where_the_settings_say_so():
    """Its views are all generated."""
    means, orbit = with_background().means, tiny.cameras(6)
    assert some_farther(orbit, [], means, NEAR, 1.0, None) == (orbit, "")
    found, told = some_farther(orbit, [], means, NEAR, 1.0, 0.5)
    assert sum(before is not after for before, after in zip(orbit, found, strict=True)) == 2 and told == ", 2 of these from farther back"


@pytest.mark.parametrize(("scale", "says"), [(1.0, True), (0.5, False)])
def test_a_file_for_a_viewer_is_adapted_to_views_from_farther_back(scale, says):
    """At the scale of its training; at another, whoever uses it has stepped back already."""
    model = VanillaModel.from_gaussians(with_background(), tiny.model(1).trained)
    base = wrap_model(model, cameras=tiny.cameras(4, width=48, height=36), backend="cpu", threads=1)
    report = base.adapt(scale, viewer="playcanvas", steps=1, extra_views=3, validation_views=2).report
    assert ("1 of these from farther back" in report.views) == says


def test_where_no_view_could_step_back_farthest_is_refused():
    base = wrap_model(VanillaModel.from_gaussians(with_background(), tiny.model(1).trained), cameras=tiny.cameras(4), backend="cpu", threads=1)
    with pytest.raises(SettingsError, match="farthest: all views are given ones"):
        base.adapt(0.5, farthest=0.5, views="train", steps=1)
    assert base.adapt(0.5, farthest=1.0, views="train", steps=1).report.views == "the 4 train views"
