"""Captures that were cut down to a part of them: most cameras see nothing of what is left."""

import warnings
from dataclasses import replace

import pytest
import tiny
import torch

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.views.shown import seeing, showing
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.levels.distance.ladder import scene_of
from mipmap_plugin.levels.request import LadderRequest
from mipmap_plugin.recipes import recipe
from mipmap_plugin.tiles.reading import make_cut
from mipmap_plugin.tiles.scene import opened

AWAY = torch.eye(4)
AWAY[2, 3] = -1000.0  # all splats lie behind it


def away(count):
    return [replace(tiny.cameras(1)[0], viewmat=AWAY, name=f"away_{number}") for number in range(count)]


def test_cameras_that_see_nothing_are_left_out():
    base, some = wrap_model(tiny.model(), cameras=[*away(30), *tiny.cameras(3)]), tiny.cameras(3)
    with pytest.warns(UserWarning, match="30 of 33 cameras see no splat, or hardly any, and are left out; so many may be of another scene"):
        adapted = base.adapt(0.5, steps=0, extra_views=8)
    alone = wrap_model(tiny.model(), cameras=some).adapt(0.5, steps=0, extra_views=8)
    assert adapted.report.views == alone.report.views and adapted.report.validation == pytest.approx(alone.report.validation)
    base.refuse_undrawn()  # of all its cameras, one in eleven sees the model


def test_tiles_and_levels_by_distance_leave_them_out_too(tmp_path):
    folder = tiny.folder(tmp_path / "base", [*away(5), *tiny.cameras(3)])
    work = tmp_path / "work"
    work.mkdir()
    make_cut(folder, 2, work)
    base, request = wrap_model(folder), LadderRequest("playcanvas", coarsest=1 / 8)
    levels = scene_of(base, request, request.first_band(base))
    for views in (lambda: opened(Base(folder), 0.5, None, recipe("default", 0.5, views="given"), work).views.adapted, lambda: levels.views):
        with pytest.warns(UserWarning, match="5 of 8 cameras see no splat"):
            assert len(showing(views(), base.model.parameters()["means"], 0.2)) == len(views()) == 3


def test_cameras_that_see_something_all_stay():
    cameras = tiny.cameras(3)
    beside = replace(cameras[0], cx=cameras[0].cx + 0.7 * cameras[0].width)  # what has its center beside the picture may reach into it
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for given in ([*cameras, beside], [*cameras, *cameras]):  # one that is given twice too
            assert seeing(given, tiny.gaussians().means, 0.2) == given


def test_cameras_stay_where_none_of_training_sees_anything():
    tests = [replace(camera, split="test") for camera in tiny.cameras(2)]
    given = [*away(2), *tests]
    assert seeing(given, tiny.gaussians().means, 0.2) == given
    with pytest.raises(SettingsError, match="none of 1 view shows a splat"):
        wrap_model(tiny.model(), cameras=away(1)).adapt(0.5, steps=0, views="given")
