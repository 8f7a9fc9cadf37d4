"""Views that show nothing, little or what is too near are refused or told of."""

import math
import re
from dataclasses import replace

import pytest
import tiny
import torch
from brief_runs import is_finite, shrunk

from mipmap_plugin.adaptation import worse
from mipmap_plugin.adaptation.views.remarks import far_apart, remarks
from mipmap_plugin.adaptation.worse import worse_views
from mipmap_plugin.camera import Camera, viewmat_of
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.scenes.orbits import Orbit
from mipmap_plugin.wrap import wrap_model

MEANS = torch.zeros(1, 3)  # of a splat in the middle of all views


def test_a_bare_file_without_cameras_adapts_on_an_orbit(tmp_path):
    adapted = wrap_model(tiny.ply(tmp_path / "base.ply")).adapt(1 / 4, steps=2, extra_views=3)
    assert adapted.report.views == "3 views of a generated orbit at 24 px (the checkpoint came without cameras)"
    assert is_finite(adapted.model)


def test_a_scene_of_which_most_is_before_the_near_plane_is_told_of():
    """What is left is adapted all the same."""
    base = wrap_model(tiny.model(), cameras=tiny.cameras())
    depths = torch.stack([camera.to_camera(base.model.parameters()["means"].detach())[:, 2] for camera in base.cameras])
    base.trained = replace(base.trained, near_plane=float(depths.median()))  # each splat is far enough in some views
    with pytest.warns(UserWarning, match=r"(4|5)\d% of the splats in a view's picture lie nearer than .* units, where renderers of 3DGS draw none"):
        base.adapt(1 / 2, recipe="instant")


def test_an_orbit_that_is_asked_for_is_not_told_of(recwarn):
    wrap_model(tiny.model()).adapt(1 / 2, steps=0, extra_views=2, merge_to=1.0, views="orbit")
    assert not recwarn


@pytest.mark.parametrize("times", [2, 4])
def test_lenses_that_differ_too_much_are_told_of(times, recwarn):
    wide, *others = tiny.cameras()
    wrap_model(tiny.model(), cameras=[wide, *others, replace(wide, fx=times * wide.fx, fy=times * wide.fy)]).adapt(1 / 2, recipe="instant")
    assert [str(each.message) for each in recwarn if "focal lengths of the cameras are" in str(each.message)] if times > 3 else not recwarn


def test_views_that_lose_while_the_others_gain_are_told_of_with_their_lenses():
    """Two of four lose, both through lenses of three times the focal length."""
    views = [replace(view, fx=times * view.fx, fy=times * view.fy) for view, times in zip(tiny.cameras(4), (1, 3, 1, 3), strict=True)]
    [told] = worse_views(views, [20.0, 36.0, 20.0, 30.0], [30.0, 28.0, 30.0, 29.0], 1 / 4, MEANS)
    assert told.startswith("in 2 of 4 views that it was chosen by, the file for x0.25 looks worse than the base, by up to 8.0 dB")
    assert f"of {3 * views[0].fx:.0f} px and more, where the shortest has {views[0].fx:.0f} px: adapt with the cameras of each lens" in told


def test_the_report_tells_of_longer_lenses_that_the_file_suits_less_than_the_base():
    views = [replace(view, fx=times * view.fx, fy=times * view.fy) for view, times in zip(tiny.cameras(8), (1, 8) * 4, strict=True)]
    with pytest.warns(UserWarning, match="the file for x0.25 looks worse than the base.* longer lenses") as told:
        report = wrap_model(tiny.model(20), cameras=views).adapt(1 / 4, recipe="instant").report
    assert [note for note in report.notes if note in {str(each.message) for each in told}]


def test_lenses_are_not_blamed_where_the_views_that_lose_have_the_same():
    [told] = worse_views(tiny.cameras(2), [20.0, 36.0], [30.0, 28.0], 1 / 4, MEANS)
    assert told.endswith("(36.0 -> 28.0), though it gains by their mean")


@pytest.mark.parametrize("depth, told_of", [(3.0, True), (6.0, False)])
def test_views_that_lose_are_called_close_ups_where_they_are_less_than_half_as_far(depth, told_of):
    """The nearest tenth of the splats tells, not what lies behind."""
    means = torch.tensor([[0.0, 0.0, 10.0]] * 2 + [[0.0, 0.0, 1000.0]] * 15)
    far, near = (Camera(32, 24, 40.0, 40.0, 16.0, 12.0, viewmat_of(torch.eye(3), torch.tensor([0.0, 0.0, 10.0 - away]))) for away in (10.0, depth))
    [told] = worse_views([far, near, far], [20.0, 36.0, 20.0], [30.0, 28.0, 30.0], 1 / 4, means)
    assert ("; they are close-ups, and what looks right from afar does not from there: adapt with the cameras of close-ups" in told) is told_of


def test_the_report_tells_of_close_ups_that_the_file_suits_less_than_the_base(monkeypatch):
    """As of longer lenses, which show the same in as many pixels."""
    monkeypatch.setattr(worse, "LONGER", math.inf)
    monkeypatch.setattr(worse, "CLOSE", 2.0)
    views = [replace(view, fx=times * view.fx, fy=times * view.fy) for view, times in zip(tiny.cameras(8), (1, 8) * 4, strict=True)]
    with pytest.warns(UserWarning, match="the file for x0.25 looks worse than the base.* close-ups"):
        wrap_model(tiny.model(20), cameras=views).adapt(1 / 4, recipe="instant")


def test_the_zooms_of_a_band_are_no_lenses():
    """All views of a level have the same lens, and lie at different zooms."""
    [told] = worse_views([view.zoomed(zoom) for view, zoom in zip(tiny.cameras(2), (0.5, 2), strict=True)], [20.0, 36.0], [30.0, 28.0], 1 / 4, MEANS)
    assert told.endswith("though it gains by their mean")


def test_generated_views_have_no_lens_that_could_be_to_blame():
    """A fifth of them are finer on purpose."""
    views = [replace(view, fx=view.fx * longer, fy=view.fy * longer) for view, longer in zip(tiny.cameras(2), (1, 2), strict=True)]
    assert ["lenses" in worse_views(views, [20.0, 36.0], [30.0, 28.0], 1 / 4, MEANS, orbit=orbit)[0] for orbit in (False, True)] == [True, False]


@pytest.mark.parametrize("after", [[21.0, 36.0], [20.0, 35.95], [21.0, 30.0]])
def test_nothing_is_told_of_views_where_none_loses_or_their_mean_does(after):
    assert worse_views(tiny.cameras(2), [20.0, 36.0], after, 1 / 4, MEANS) == []


def moved_away(times, **size):
    """Two cameras, so many times as far from the middle of the scene."""
    return [view.moved(torch.diag(torch.tensor([times, times, times, 1.0], dtype=torch.float64))) for view in tiny.cameras(2, **size)]


def test_a_scene_nearer_than_the_near_plane_is_refused_with_what_to_do():
    with pytest.raises(SettingsError, match=r"all splats lie nearer than 0.2 units, .* scale the scene up, with its cameras if it has any"):
        wrap_model(shrunk(0.01), cameras=moved_away(0.01)).adapt(0.5, steps=0, views="given")


def test_a_scene_in_small_units_is_told_of_where_the_near_plane_keeps_views_away_from_it():
    base = wrap_model(shrunk(0.02))
    views = Orbit.around(base.model.parameters()["means"]).views((800, 800), 4, torch.Generator().manual_seed(0))
    where = r"the scene is 0.0\d+ units wide, and no view shows it larger than \S+ px: renderers of 3DGS draw nothing nearer than 0.2 units; "
    where += "scale the scene up, with its cameras if it has any"  # here it has none
    [remark] = remarks(views, base.model, 0.2, orbit=True)
    assert re.match(where, remark) and not remarks(views, base.model, 0.2, orbit=False)
    with pytest.raises(SettingsError, match="the cameras seem to be in other units"):
        wrap_model(tiny.model(), cameras=moved_away(100.0)).adapt(0.5, recipe="instant")


@pytest.mark.parametrize("size", [0.1, 1e-4])
def test_a_small_scene_is_adapted_as_a_large_one_and_told_of(size):
    """As phones scan objects in meters: it was seen from too far away, and adapted to smaller pictures than was asked for, or refused."""
    usual = wrap_model(shrunk(1.0)).adapt(1 / 4, recipe="instant", extra_views=4)
    told = r"nearer than 0\.2 units are drawn here, too; renderers of 3DGS draw none of these: if .* scale the scene up"
    with pytest.warns(UserWarning, match=told):
        small = wrap_model(shrunk(size)).adapt(1 / 4, recipe="instant", extra_views=4)
    shapes = [adapted.model.parameters()["scales"].detach() for adapted in (usual, small)]
    assert len(small.model) == len(usual.model)
    torch.testing.assert_close(shapes[1] - math.log(size), shapes[0], atol=0.05, rtol=0)


def test_a_viewer_with_a_near_plane_draws_a_small_scene_in_views_that_frame_it():
    """Else a file for it, or for several viewers, would be adapted to pictures of nothing."""
    base = wrap_model(shrunk(0.02))
    assert base.effects(viewer="classic").near_plane == base.effects().near_plane < 0.003
    assert wrap_model(shrunk(1.0)).effects(viewer="gsplat").near_plane == 0.01
    assert wrap_model(shrunk(0.02), cameras=tiny.cameras()).effects().near_plane == 0.2


@pytest.mark.parametrize("count", [1, 2])
def test_a_few_splats_are_no_small_scene(count):
    """Whose centers say nothing about its size: one was looked at from within."""
    splats = tiny.gaussians(count)
    model = VanillaModel.from_gaussians(replace(splats, means=1e-3 * splats.means))
    assert wrap_model(model).effects().near_plane == 0.2


def test_things_far_apart_are_told_of_where_an_orbit_shows_them_as_specks():
    room = 10 * torch.rand(2000, 3, generator=torch.Generator().manual_seed(0))
    assert re.match(r"the splats are a few things, 1,\d+ units apart, ", far_apart(torch.cat([room, room + 1000])))
    assert far_apart(room) == far_apart(torch.cat([room, room + 20])) == far_apart(room * 0) == far_apart(room[:5]) == ""


def test_the_near_plane_is_not_blamed_where_it_keeps_no_camera_away():
    """Scaled up with its cameras, such a scene would look the same: it is far away, or the lens is wide."""
    far, wide = tiny.cameras(2), [replace(view, fx=1.0, fy=1.0) for view in tiny.cameras(2)]
    for model, views in ((shrunk(0.02), far), (tiny.model(300), wide)):
        with pytest.raises(SettingsError, match=r"no view shows it larger than \S+ px: the cameras seem to be in other units"):
            wrap_model(model, cameras=views).adapt(0.5, recipe="instant")


@pytest.mark.parametrize(("count", "spread"), [(1, 0.0), (5, 0.1)])
def test_few_splats_may_be_small_as_they_are_as_large_as_pixels(count, spread):
    views, few, many = moved_away(3.0, width=64, height=64), tiny.model(count, spread=spread), tiny.model(300, spread=spread)
    assert len(wrap_model(few, cameras=views).adapt(0.5, steps=1, views="given").model) == count
    with pytest.raises(SettingsError, match=r"no view shows it larger than .* px: the cameras seem to be in other units"):
        wrap_model(many, cameras=views).adapt(0.5, steps=1, views="given")


@pytest.mark.parametrize("viewer", [None, "spark"])  # for which it is converted at x1 before
def test_a_small_scene_may_be_zoomed_into(viewer):
    base = wrap_model(tiny.model(), cameras=moved_away(12.0))
    small = r"no view shows it larger than \d\S* px: the cameras seem to be in other units"
    for scale in (0.5, 1.1):
        with pytest.raises(SettingsError, match=small):
            base.adapt(scale, steps=1, viewer=viewer)
    with pytest.warns(UserWarning, match=small):
        assert base.adapt(8, steps=1, viewer=viewer, extra_views=1).report.scale == 8


def test_a_model_of_which_nothing_is_drawn_is_refused_and_one_of_which_little_is_is_not():
    faint = tiny.model()
    faint.parameters()["opacities"][:] = -8.0
    base = wrap_model(faint, cameras=tiny.cameras(2))
    for scale in (0.5, 1):
        with pytest.raises(SettingsError, match="below 1/255 and are never drawn; the training or the export failed"):
            base.adapt(scale, steps=0, views="given")
    faint.parameters()["opacities"][7] = 2.0
    away = replace(tiny.cameras(1)[0], viewmat=HALF_TURN @ tiny.cameras(1)[0].viewmat)
    wrap_model(faint, cameras=[away, *tiny.cameras(2)]).adapt(0.5, steps=0, views="given")


def test_views_that_show_nothing_do_not_count_in_the_mean():
    """They are at 120 dB, whatever the others show."""
    away = [replace(view, viewmat=HALF_TURN @ view.viewmat) for view in tiny.cameras(3)]
    model = wrap_model(tiny.model(), cameras=[*tiny.cameras(3), *away])
    alone = wrap_model(tiny.model(), cameras=tiny.cameras(3))
    settings = dict(steps=1, views_per_step=400, extra_views=0)  # many views for validation
    both, without = (each.adapt(0.5, **settings).report.psnr_before() for each in (model, alone))
    assert both == pytest.approx(without, abs=6)


HALF_TURN = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
