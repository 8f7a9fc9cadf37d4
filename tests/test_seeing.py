"""Captures that were cut down to a part of them: most cameras see nothing of what is left."""

import warnings
from dataclasses import replace

import pytest
import tiny
import torch

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.seeing import seeing
from mipmap_plugin.errors import SettingsError

AWAY = torch.eye(4)
AWAY[2, 3] = -1000.0  # all splats lie behind it


def away(count):
    return [replace(tiny.cameras(1)[0], viewmat=AWAY, name=f"away_{number}") for number in range(count)]


def test_cameras_that_see_nothing_are_left_out():
    base, some = wrap_model(tiny.model(), cameras=[*away(30), *tiny.cameras(3)]), tiny.cameras(3)
    with pytest.warns(UserWarning, match="30 of 33 cameras see no splat, or hardly any, and are left out"):
        adapted = base.adapt(0.5, steps=0, extra_views=8)
    alone = wrap_model(tiny.model(), cameras=some).adapt(0.5, steps=0, extra_views=8)
    assert adapted.report.views == alone.report.views and adapted.report.validation == pytest.approx(alone.report.validation)
    base.refuse_undrawn()  # of all its cameras, one in eleven sees the model


def test_cameras_that_see_something_all_stay():
    cameras = tiny.cameras(3)
    beside = replace(cameras[0], cx=cameras[0].cx + 0.7 * cameras[0].width)  # what has its center beside the picture may reach into it
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for given in ([*cameras, beside], [*cameras, *cameras]):  # one that is given twice too
            assert seeing(given, tiny.model(), 0.2) == given


def test_cameras_stay_where_none_of_training_sees_anything():
    tests = [replace(camera, split="test") for camera in tiny.cameras(2)]
    given = [*away(2), *tests]
    assert seeing(given, tiny.model(), 0.2) == given
    with pytest.raises(SettingsError, match="none of the 20 views shows a splat"):
        wrap_model(tiny.model(), cameras=away(20)).adapt(0.5, steps=0, views="given")
