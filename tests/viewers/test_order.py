"""The order in which a viewer draws: by depth, by distance or in buckets."""

from dataclasses import replace
from functools import reduce

import pytest
import torch
from one_splat import BOTH, DEPTH, MIDDLE, camera, splat

from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import USUAL, EvenBuckets, RenderSettings
from mipmap_plugin.splatting.buckets import even_ranks, ranks, ranks_of_views
from mipmap_plugin.splatting.viewers import find_viewer


@BOTH
def test_spark_sorts_by_distance(backend):
    """The splat of lesser depth may be farther from the camera, if it is off-axis."""
    near, far = splat(900.0, 900.0, 1.0, 1.0, means=(0.0, 0.0, 10.0)), splat(900.0, 900.0, 1.0, 0.0, means=(4.6, 0.0, 9.9))
    pair = near.joined(far)
    wide = replace(camera(), width=120, cx=60.0)
    first = {name: backend.render(pair, wide, find_viewer(name).effects(Effects(0))).image[MIDDLE, 82, 0].item() for name in ("spark", "classic")}
    assert first["spark"] > 0.5 > first["classic"]


def test_buckets_are_finer_near_the_camera():
    """A box 960 deep with the camera in its middle: 32 bins of 30 units, 1025 buckets for 209 weights.

    The bin before the camera has 20 weights, 98 buckets of 0.31 units; eleven bins from it, it is 1 weight, 4 buckets of 7.5 units.
    """
    depths = torch.tensor([10.0, 10.5, 310.0, 310.5, 311.0])
    means = torch.zeros(6, 3)
    means[1:, 2], means[0, 2] = depths, 0.0
    means[1:, 0] = torch.tensor([4.0, 3.0, 2.0, 1.0, 0.0])  # Morton's order is that of x
    scales = torch.full((6, 3), 1e-3)
    scales[0] = 240.0  # the box ends at two of them
    [places] = ranks(Gaussians(means, torch.ones(6, 4), scales, torch.ones(6), torch.zeros(6, 1, 3)), [camera()])
    assert places[1] < places[2] < min(places[3:])  # by depth
    assert places[5] < places[4] < places[3]  # by x


@BOTH
def test_playcanvas_does_not_sort_within_a_bucket(backend):
    """In a bounding box so deep that two splats share a bucket, the one in the lower cell along x is composited in front, though it is behind."""
    near, far = splat(40.0, 40.0, 1.0, 1.0, means=(0.01, 0.0, 10.0)), splat(40.0, 40.0, 1.0, 0.0, means=(-0.01, 0.0, 10.01))
    large = replace(splat(1.0, 1.0, means=(0.0, 0.0, -50.0)), scales=torch.full((1, 3), 1e3))
    drawn = {}
    for context in ((), (large,)):
        parts = (near, far, *context)
        together = reduce(Gaussians.joined, parts)
        drawn[len(parts)] = backend.render(together, camera(), find_viewer("playcanvas").effects(Effects(0))).image[MIDDLE, MIDDLE, 0].item()
    assert drawn[2] > 0.9 and drawn[3] < 0.1


def test_buckets_of_babylon_are_even():
    """1025 buckets over 1024 units of depth: one unit each, wherever the camera is. Within one the earlier row is in front."""
    depths = torch.tensor([0.0, 1024.0, 500.9, 500.1, 499.9])
    means = torch.cat([torch.zeros(5, 2), depths[:, None]], 1)
    splats = Gaussians(means, torch.ones(5, 4), torch.ones(5, 3), torch.ones(5), torch.zeros(5, 1, 3))
    assert even_ranks(splats, camera(), EvenBuckets()).tolist() == [0, 4, 2, 3, 1]
    assert even_ranks(splats, camera(), EvenBuckets(1024, later_in_front=True)).tolist() == [0, 4, 3, 2, 1]
    larger = replace(splats, scales=torch.tensor([1.0, 1.0, 1.0, 2.0, 1.0])[:, None].expand(5, 3))
    assert even_ranks(larger, camera(), EvenBuckets(1024, largest_first=True)).tolist() == [0, 4, 3, 2, 1]


def test_buckets_of_three_js_divide_a_sphere_around_all_splats():
    """Of a middle at a depth of 50 and a radius of 50 + 2 · 5: it ends at 110, and begins before the camera's least depth of 10."""
    means = torch.zeros(5, 3)
    means[:, 2] = torch.tensor([0.0, 100.0, 29.9, 20.1, 19.9])
    splats = Gaussians(means, torch.ones(5, 4), torch.full((5, 3), 5.0), torch.ones(5), torch.zeros(5, 1, 3))
    places = even_ranks(splats, camera(), EvenBuckets(10, sphere_from=10.0, later_in_front=True))  # buckets of 10 units
    assert places.tolist() == [1, 4, 3, 2, 0]


def test_the_order_of_several_views_is_that_of_each():
    means = torch.randn(50, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([0.0, 0.0, DEPTH])
    splats = Gaussians(means, torch.ones(50, 4), torch.ones(50, 3), torch.ones(50), torch.zeros(50, 1, 3))
    aside = camera().looking_from(torch.tensor([[0.6, 0.0, -0.8, 6.0], [0.0, 1.0, 0.0, 0.0], [0.8, 0.0, 0.6, 4.0], [0.0, 0.0, 0.0, 1.0]]), "")
    bucketed, even = RenderSettings(bucketed=True), EvenBuckets(10)
    asked = [(aside, bucketed), (aside, RenderSettings(even_buckets=even)), (camera(), USUAL), (camera(), bucketed)]
    found = ranks_of_views(splats, [(view, Effects(0, settings=settings)) for view, settings in asked])
    expected = [*ranks(splats, [aside]), even_ranks(splats, aside, even), None, *ranks(splats, [camera()])]
    assert [None if own is None else own.tolist() for own in found] == [None if own is None else own.tolist() for own in expected]
    assert not torch.equal(expected[0], expected[3])


@BOTH
@pytest.mark.parametrize(
    ("viewer", "front"), [("three", 1.0), ("gaussian-splats-3d", 1.0), ("viser", 1.0), ("gsplat-js", 0.0), ("antimatter15", 0.0), ("babylon", 0.0)]
)
def test_a_viewer_does_not_sort_within_a_bucket(backend, viewer, front):
    """Beside a center so far away that two splats share a bucket, either the later row is in front, or the earlier one, whatever their depths."""
    rows = [splat(40.0, 40.0, 1.0, color, means=(0.0, 0.0, 10.0)) for color in (0.0, 1.0)]
    nearer = replace(rows[0], means=rows[0].means - torch.tensor([0.0, 0.0, 0.01]))
    far = splat(1.0, 1.0, means=(0.0, 0.0, 1e4))
    for parts, expected in (((nearer, rows[1]), 0.0), ((nearer, rows[1], far), front), ((rows[1], nearer, far), 1 - front)):
        together = reduce(Gaussians.joined, parts)
        drawn = backend.render(together, camera(), find_viewer(viewer).effects(Effects(0))).image[MIDDLE, MIDDLE, 0].item()
        assert drawn == pytest.approx(expected, abs=0.1)


def test_the_order_is_one_or_the_other():
    for orders in (dict(radial=True, bucketed=True), dict(bucketed=True, even_buckets=EvenBuckets())):
        with pytest.raises(SettingsError, match="`radial`, `bucketed` and `even_buckets` are different orders"):
            RenderSettings(**orders)
