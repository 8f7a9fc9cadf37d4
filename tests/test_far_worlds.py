"""Scenes far from the origin, such as georeferenced captures: images are the same as at the origin."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tiny import cameras

from mipmap_plugin.adaptation.optimization.density import ScreenGradients
from mipmap_plugin.adaptation.pixel_size import pixel_size
from mipmap_plugin.models.mip import filter_3d_of

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
