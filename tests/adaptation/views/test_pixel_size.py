"""The size of a pixel at a splat: in the closest view of it, in the mean of its views, and how many of these are looked at."""

import importlib.util
import math
from dataclasses import replace

import pytest
import tiny
import torch
from levels_by_distance import from_x, with_background

from mipmap_plugin.adaptation.views import pixel_size as module
from mipmap_plugin.adaptation.views.pixel_size import (
    LEAST_VIEWS,
    MOST_VIEWS,
    SEEN,
    enough_views,
    is_unbounded,
    mean_pixel_size,
    pixel_size,
    views_for,
)
from mipmap_plugin.backends.cpu import finest_pixels
from mipmap_plugin.camera import Camera

FOCAL = 40.0
VIEW = Camera(32, 24, FOCAL, FOCAL, 16.0, 12.0, torch.eye(4))
CLOSER = VIEW.looking_from(torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -2], [0, 0, 0, 1]]), "closer")
AWAY = VIEW.looking_from(torch.diag(torch.tensor([1.0, -1, -1, 1])), "away")


def test_a_pixel_is_the_depth_over_the_focal_length():
    means = torch.tensor([[0.0, 0.0, 4.0], [0.5, 0.2, 2.0]])
    torch.testing.assert_close(pixel_size(means, [VIEW]), torch.tensor([4.0, 2.0]) / FOCAL)
    anamorphic = replace(VIEW, fx=20.0, fy=80.0)
    torch.testing.assert_close(pixel_size(means[:1], [anamorphic]), means.new_tensor([4 / math.sqrt(20 * 80)]))


def test_a_pixel_is_that_of_the_closest_view_that_sees_the_splat():
    means = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 1.0], [1.5, 0.0, 0.5]])  # both see it; only the first does; none does
    torch.testing.assert_close(pixel_size(means, [VIEW, CLOSER]), torch.tensor([2.0, 1.0, math.hypot(1.5, 0.5)]) / FOCAL)


@pytest.mark.parametrize("size", [pixel_size, mean_pixel_size])
def test_what_no_view_sees_has_no_larger_pixels_than_what_one_does(size):
    """Else another room, a kilometer away, would become a blur."""
    near, far = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 1.0]]), torch.tensor([[1000.0, 0.0, 4.0]])
    torch.testing.assert_close(size(torch.cat([near, far]), [VIEW]), torch.tensor([4.0, 1.0, 4.0]) / FOCAL)
    torch.testing.assert_close(size(far, [VIEW]), torch.tensor([math.hypot(1000, 4)]) / FOCAL)


def test_a_broken_numba_leaves_it_to_torch(monkeypatch):
    monkeypatch.setattr("mipmap_plugin.backends.cpu.missing", lambda: ["numba does not load"])
    torch.testing.assert_close(pixel_size(torch.tensor([[0.0, 0.0, 4.0]]), [VIEW]), torch.tensor([4.0]) / FOCAL)


@pytest.mark.skipif(not importlib.util.find_spec("numba"), reason="numba is not installed")
@pytest.mark.parametrize("near", [0.0, 3.0])
def test_compiled_code_finds_what_torch_finds(near, monkeypatch):
    """Of means behind cameras and beside their pictures too."""
    means = 6 * torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    views, found = [VIEW, CLOSER, AWAY], finest_pixels(means, [VIEW, CLOSER, AWAY], near)
    monkeypatch.setattr(module, "finest_pixels", lambda *_: None)
    sizes, seeing = module._finest(means, views, near)
    assert torch.equal(seeing, found[1]) and 0 < seeing.count_nonzero() < 500
    torch.testing.assert_close(sizes, found[0], rtol=1e-6, atol=0)


def test_a_pixel_has_a_size_in_the_plane_of_the_camera_too():
    """Else weights over it are infinite, and merged colors NaN."""
    size = pixel_size(torch.tensor([[1.0, 0.0, 0.0]]), [VIEW])
    assert size.item() == pytest.approx(1 / FOCAL)
    assert pixel_size(VIEW.center[None].float(), [VIEW]).pow(-2).isfinite().all()


def test_the_mean_pixel_is_that_of_least_squares_in_the_pixels_of_the_views():
    """Depths of 4 and 2, focal length 40: variances of c px² there are c/100 and c/400, and that of both is c/340."""
    means = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 1.0], [1.5, 0.0, 0.5]])  # both see it; only the first does; none does
    found = mean_pixel_size(means, [VIEW, CLOSER])
    torch.testing.assert_close(found[0].square(), torch.tensor(1 / 340))
    torch.testing.assert_close(found[1:], pixel_size(means, [VIEW, CLOSER])[1:])


@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_the_mean_pixel_holds_in_any_unit(unit):
    views = [view.looking_from(torch.cat([view.viewmat[:, :3], view.viewmat[:, 3:] * torch.tensor([[unit], [unit], [unit], [1.0]])], dim=1), "far")
             for view in (VIEW, CLOSER)]  # fmt: skip
    found = mean_pixel_size(torch.tensor([[0.0, 0.0, 4.0]]) * unit, views)
    torch.testing.assert_close(found / unit, torch.tensor([1 / math.sqrt(340)]))


@pytest.mark.parametrize(("share", "count"), [(1.0, LEAST_VIEWS), (SEEN / LEAST_VIEWS, LEAST_VIEWS), (0.4, 2 * LEAST_VIEWS), (0.1, 8 * LEAST_VIEWS)])
def test_views_are_doubled_until_they_show_a_splat_often_enough(share, count):
    assert views_for(share) == count
    assert views_for(0.0) == MOST_VIEWS


def test_of_a_walk_through_rooms_more_views_are_looked_at_than_of_an_object():
    ring, means = tiny.cameras(40), tiny.gaussians(60).means
    assert enough_views(means, ring) == LEAST_VIEWS
    rooms = torch.cat([means + torch.tensor([100.0 * room, 0.0, 0.0]) for room in range(9)])
    assert enough_views(rooms, ring) > LEAST_VIEWS


def test_the_closest_view_is_looked_for_among_more_views():
    """Of 40 views one is twice as close: every third does not show it."""
    views = [CLOSER if number == 1 else VIEW for number in range(40)]
    torch.testing.assert_close(pixel_size(torch.tensor([[0.0, 0.0, 4.0]]), views, 12), torch.tensor([2.0]) / FOCAL)


def test_too_many_rare_splats_to_look_at_more_views_are_not_looked_at_twice(monkeypatch):
    looked, finest = [], module._finest
    monkeypatch.setattr(module, "_finest", lambda means, views, *near: looked.append(len(views)) or finest(means, views, *near))
    monkeypatch.setattr(module, "MOST_LOOKS", 100)
    pixel_size(torch.tensor([[0.0, 0.0, 4.0]]).expand(10, 3), [VIEW, *[AWAY] * 199], 12)
    assert looked == [40]


def test_the_closest_view_of_what_few_views_show_is_looked_for_among_all():
    """Of 200 views, of which every fifth is looked at, two show the splat, and the closer is not among these."""
    views = [VIEW, CLOSER, *[AWAY] * 198]
    torch.testing.assert_close(pixel_size(torch.tensor([[0.0, 0.0, 4.0]]), views, 12), torch.tensor([2.0]) / FOCAL)


def test_scenes_with_a_background_are_unbounded_and_objects_are_not():
    views = tiny.cameras(6)
    assert is_unbounded(with_background().means, views, 0.01)
    assert not is_unbounded(tiny.gaussians(200).means, views, 0.01)


def test_a_scene_that_no_camera_sees_is_not_unbounded():
    assert not is_unbounded(torch.cat([torch.zeros(5, 3), torch.full((5, 3), 100.0)]), [from_x(1e6)], 0.01)
