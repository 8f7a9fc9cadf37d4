"""Where a viewer changes levels, and the views that this is measured in."""

import math
from dataclasses import replace

import pytest
import tiny
import torch

from mipmap_plugin import wrap_model
from mipmap_plugin.levels.switching import most_even, switching_zoom, zooms_between
from mipmap_plugin.levels.yardstick import Yardstick
from mipmap_plugin.models.vanilla import VanillaModel


def test_switches_lie_where_both_levels_are_equally_good():
    def falls_and_rises(zoom):
        return 30 + 10 * math.log2(zoom / 0.25), 36 - 10 * math.log2(zoom / 0.25)

    assert switching_zoom(0.25, 0.5, falls_and_rises) == pytest.approx(0.25 * 2**0.3, rel=0.02)


def test_of_two_crossings_the_better_is_taken():
    assert most_even([(20, 20.2), (24, 21), (29, 29.4), (31, 30)]) == 2


@pytest.mark.parametrize(("ahead", "zoom"), [(1, 0.25), (-1, 1.0)])
def test_a_level_that_is_better_throughout_is_shown_throughout(ahead, zoom):
    """Though it is less so at the other end: a capture was shown 2 dB worse from x1 down, by a level that is 2.5 dB worse further down."""

    def measure(at):
        return 30 + ahead * (5 - abs(math.log2(zoom / at))), 30

    assert switching_zoom(0.25, 1.0, measure) == zoom


def test_a_switch_lies_on_the_better_side_of_a_step():
    """Images of 15 and of 16 pixels, say."""
    zoom = switching_zoom(0.5, 1.0, lambda zoom: (32.5, 32.9) if zoom < 0.7 else (34.3, 31.0))
    assert 0.5 <= zoom < 0.7


def test_zooms_include_both_ends():
    assert zooms_between(0.25, 0.25, 2) == [0.25]
    assert zooms_between(0.25, 1, 2) == pytest.approx([0.25, 0.5, 1])
    assert len(zooms_between(0.25, 1.01, 2)) == 4


def test_levels_are_measured_by_views_that_show_something():
    """Between objects far apart most random views show nothing."""
    one, other = tiny.gaussians(40), tiny.gaussians(40, seed=2)
    away = torch.tensor([1000.0, 0.0, 0.0])
    both = one.joined(replace(other, means=other.means + away))
    there = torch.eye(4, dtype=torch.float64)
    there[:3, 3] = away.double()
    cameras = [*tiny.cameras(3), *(view.moved(there) for view in tiny.cameras(3))]
    base = wrap_model(VanillaModel.from_gaussians(both), cameras=cameras)
    yardstick = Yardstick(base, seed=0)
    assert len(yardstick._images) == 4 and all(image.std() > 0 for image in yardstick._images.values())
