"""Scenes far from the origin, such as georeferenced captures: images are the same as at the origin."""

from dataclasses import replace

import pytest
import tiny
import torch
from tiny import cameras

from mipmap_plugin.adaptation.optimization.density import ScreenGradients
from mipmap_plugin.adaptation.views.pixel_size import pixel_size
from mipmap_plugin.adaptation.views.remarks import too_far_out
from mipmap_plugin.effects import Effects
from mipmap_plugin.models.mip import filter_3d_of
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.splatting.viewers import find_viewer
from mipmap_plugin.wrap import wrap_model

# World units. float32 knows places to 1/16 unit there, and rotation · point + translation to no better than 1/4.
FAR = torch.tensor([1e6, -1e6, 5e5], dtype=torch.float64)
POINTS = (torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 16).floor() / 8 - 1


def moved(camera):
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] -= viewmat[:3, :3] @ FAR
    return replace(camera, viewmat=viewmat)


@pytest.fixture
def views():
    """From eyes whose places float32 holds exactly out there too."""
    turned = []
    for view in cameras():
        viewmat = view.viewmat.clone()
        viewmat[:3, 3] = -viewmat[:3, :3] @ (view.center * 8).round().div(8)
        turned.append(replace(view, viewmat=viewmat))
    return turned


def screen_gradients(points, view):
    record = ScreenGradients(len(points), points.device)
    record.add(points, torch.ones_like(points), view)
    return record.mean()


@pytest.mark.parametrize(
    "seen",
    [
        lambda points, views: views[0].to_camera(points),
        lambda points, views: pixel_size(points, views),
        lambda points, views: filter_3d_of(points, views),
        lambda points, views: screen_gradients(points, views[0]),
    ],
    ids=["in camera space", "a pixel's size", "the 3D filter", "screen gradients"],
)
def test_it_is_seen_as_at_the_origin(seen, views):
    here, there = seen(POINTS, views), seen(POINTS + FAR.float(), [moved(view) for view in views])
    torch.testing.assert_close(there, here, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("viewer", "is_off"), [("spark", True), ("playcanvas", False)])
def test_a_viewer_that_keeps_positions_in_16_bits_does_not_suit_a_scene_out_there(viewer, is_off):
    targets, here = {viewer: find_viewer(viewer).effects(Effects(1))}, tiny.gaussians()
    there = VanillaModel.from_gaussians(replace(here, means=here.means + FAR.float()))
    assert too_far_out(VanillaModel.from_gaussians(here), cameras(), targets) == ""
    assert ("spark keeps positions in 16 bits, by which 100% of" in too_far_out(there, [moved(view) for view in cameras()], targets)) == is_off


def test_adapting_for_such_a_viewer_warns():
    splats, view = tiny.gaussians(), cameras(1, width=8, height=6)[0]
    far = wrap_model(VanillaModel.from_gaussians(replace(splats, means=splats.means + FAR.float())), cameras=[moved(view)], backend="reference")
    with pytest.warns(UserWarning, match="spark keeps positions in 16 bits.*the world.s origin, with its cameras, or give another viewer"):
        far.adapt(1 / 2, recipe="instant", merge_to=1.0, viewer="spark", views="given", validation_views=2)
