"""Shared by the GPU backends: the preparation of splats for other projects' rasterizers."""

from __future__ import annotations

import torch

from mipmap_plugin.backends.reference import finite_rows
from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians

NO_CUDA = "it needs a CUDA GPU, and torch sees none here"


def at_the_origin(camera: Camera) -> Camera:
    """The camera moved to the origin, with the same rotation."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = camera.viewmat[:3, :3]
    return camera.looking_from(viewmat, camera.name)


def finite_splats(gaussians: Gaussians) -> Gaussians:
    """The splats whose every number is finite; a single NaN can spread over an image. Synchronizes with the GPU."""
    finite = finite_rows(gaussians)
    return gaussians if bool(finite.all()) else gaussians[finite]
