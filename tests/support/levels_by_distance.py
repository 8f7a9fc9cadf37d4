"""A ball before a far sky, and cameras along a line, for levels by distance."""

from dataclasses import replace

import tiny
import torch

from mipmap_plugin import wrap_model
from mipmap_plugin.camera import Camera
from mipmap_plugin.models.vanilla import VanillaModel


def with_background(near=300, far=200):
    """A ball that the cameras surround, and a sky far behind it."""
    rng, ball = torch.Generator().manual_seed(3), tiny.gaussians(near, degree=0)
    sky = tiny.gaussians(far, degree=0, seed=5, spread=1.0)
    away = sky.means / sky.means.norm(dim=1, keepdim=True) * (14 + 8 * torch.rand(far, 1, generator=rng))
    return replace(ball, scales=ball.scales / 3).joined(replace(sky, means=away, scales=8 * sky.scales))


def wrapped(**counts):
    model = VanillaModel.from_gaussians(with_background(**counts), tiny.model(1).trained)
    return wrap_model(model, cameras=tiny.cameras(3, width=48, height=36), backend="cpu", threads=1)


def from_x(x):
    """A camera at (x, 0, 0)."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -x
    return Camera(100, 100, 100.0, 100.0, 50, 50, viewmat)
