"""The demo world: its images agree across resolutions, and it shows what the demo needs."""

import math

import pytest
import torch

from mipmap_plugin.demo.geometry import Capsules, nothing
from mipmap_plugin.demo.world import cameras, orbit_camera, render_world, shade, surface_points, trace
from mipmap_plugin.errors import SettingsError


def project(camera, points):
    local = points.double() @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    return local[:, :2] / local[:, 2:] * torch.tensor([camera.fx, camera.fy]) + torch.tensor([camera.cx, camera.cy]), local[:, 2]


def capsule(start, end, radius):
    start, end = torch.tensor([start]), torch.tensor([end])
    length = (end - start).norm(dim=1)
    flat = torch.zeros(1)
    return Capsules(start, (end - start) / length[:, None], length, torch.tensor([radius]), torch.ones(1, 3), torch.zeros(1, 3), flat, flat)


def met(solid, origin, direction):
    direction = torch.nn.functional.normalize(torch.tensor([direction]), dim=1)
    best = nothing(direction)
    solid.hit(torch.tensor([origin]), direction, best)
    return best


def test_a_low_resolution_image_is_the_mean_of_a_high_one():
    camera = cameras(24, 3, "test")[1]
    fine = render_world(camera.zoomed(4), samples=1)
    torch.testing.assert_close(render_world(camera, samples=16), fine.view(24, 4, 24, 4, 3).mean(dim=(1, 3)), atol=1e-3, rtol=0)


def test_one_sample_per_pixel_aliases():
    camera = orbit_camera(48)
    assert (render_world(camera, samples=1) - render_world(camera, samples=16)).abs().mean() > 0.01


def test_bands_of_rows_join_seamlessly(monkeypatch):
    camera = orbit_camera(32)
    whole = render_world(camera, samples=4)
    monkeypatch.setattr("mipmap_plugin.demo.world.RAYS_PER_CHUNK", 1000)
    torch.testing.assert_close(render_world(camera, samples=4), whole, atol=1e-3, rtol=0)


def test_a_wide_image_keeps_its_shape():
    assert render_world(orbit_camera(16).resized(20, 12), samples=1).shape == (12, 20, 3)


@pytest.mark.parametrize("split", ["train", "test"])
def test_every_camera_sees_the_whole_object_on_white(split):
    for camera in cameras(40, 8, split):
        image = render_world(camera, samples=1)
        colored = (image < 1).any(dim=-1)
        assert colored.float().mean() > 0.2
        assert not (colored[0].any() or colored[-1].any() or colored[:, 0].any() or colored[:, -1].any())
        assert image.min() >= 0 and image.max() <= 1


def test_up_is_up():
    pixels, depth = project(orbit_camera(64), torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert pixels[1, 1] < pixels[0, 1] and (depth > 0).all()


def test_test_cameras_stand_between_the_train_cameras():
    train = torch.stack([camera.center for camera in cameras(8, 20, "train")])
    test = torch.stack([camera.center for camera in cameras(8, 20, "test")])
    assert torch.cdist(train, test).min() > 0.1
    assert {camera.split for camera in cameras(8, 2, "test")} == {"test"}


def color_at(point, eye):
    direction = torch.nn.functional.normalize(torch.tensor([point]) - torch.tensor([eye]), dim=1)
    hit = trace(torch.tensor([eye]), direction)
    return shade(torch.tensor([point]), direction, hit)[0]


@pytest.mark.parametrize("top, least, most", [((-0.42, -0.58, 0.62), 0.05, 1.0), ((0.56, -0.5, 0.58), 0.0, 1e-4)], ids=["mirror", "striped"])
def test_only_the_mirror_ball_changes_color_with_the_view(top, least, most):
    one, other = (color_at(top, eye) for eye in ((-1.0, -3.0, 1.5), (3.0, -1.0, 3.0)))
    assert least <= (one - other).abs().max() <= most


def test_surface_points_lie_on_surfaces():
    points, colors = surface_points(500, torch.Generator().manual_seed(0))
    assert points.shape == colors.shape == (500, 3)
    assert points.norm(dim=1).max() < 1.4
    above = points + torch.tensor([0.0, 0.0, 3.0])
    gap = 3 - trace(above, torch.tensor([[0.0, 0.0, -1.0]]).expand(500, 3)).distance
    upright = points[:, :2].norm(dim=1) > 1.149  # on the platform's side, which a ray from above only grazes
    assert (gap > -1e-3)[~upright].float().mean() > 0.99
    assert (gap.abs() < 1e-3).float().mean() > 0.5


@pytest.mark.parametrize("samples", [-4, 0, 2, 15])
def test_samples_must_fill_a_square(samples):
    with pytest.raises(SettingsError, match="samples"):
        render_world(orbit_camera(4), samples=samples)


def test_an_unknown_split_is_refused():
    with pytest.raises(SettingsError, match="split"):
        cameras(8, 1, "validation")


@pytest.mark.parametrize(
    "origin, direction, distance, normal",
    [
        ((0.5, -3.0, 0.0), (0.0, 1.0, 0.0), 2.9, (0.0, -1.0, 0.0)),  # side
        ((-3.0, 0.0, 0.0), (1.0, 0.0, 0.0), 2.9, (-1.0, 0.0, 0.0)),  # end, along the axis
        ((4.0, 0.0, 0.0), (-1.0, 0.0, 0.0), 2.9, (1.0, 0.0, 0.0)),  # other end
        ((0.5, -3.0, 0.2), (0.0, 1.0, 0.0), math.inf, (0.0, 0.0, 0.0)),  # passes above
        ((1.2, -3.0, 0.0), (0.0, 1.0, 0.0), math.inf, (0.0, 0.0, 0.0)),  # meets the cylinder, not the capsule
        ((0.5, 3.0, 0.0), (0.0, 1.0, 0.0), math.inf, (0.0, 0.0, 0.0)),  # behind the ray
    ],
)
def test_a_ray_meets_a_capsule(origin, direction, distance, normal):
    hit = met(capsule((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.1), origin, direction)
    torch.testing.assert_close(hit.distance, torch.tensor([distance]))
    torch.testing.assert_close(hit.normal, torch.tensor([normal]), atol=1e-4, rtol=0)


def test_a_hair_far_away_keeps_its_thickness():
    hair = capsule((0.0, 0.0, -0.1), (0.0, 0.0, 0.1), 0.002)
    edges = [met(hair, (x, -50.0, 0.0), (0.0, 1.0, 0.0)).distance.isfinite().item() for x in (0.0019, 0.0021)]
    assert edges == [True, False]
