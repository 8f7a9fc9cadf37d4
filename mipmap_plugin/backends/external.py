"""Requirement checks that backends share, and the preparation of splats for other projects' rasterizers."""

from __future__ import annotations

import torch
from torch import Tensor

from mipmap_plugin.backends.base import Backend, Needs
from mipmap_plugin.backends.reference import finite_rows
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import BackendUnavailable
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.rotations import unit

NO_CUDA = "it needs a CUDA GPU, and torch sees none here"


class CachedCheck:
    """Checks once per kind of request whether a backend can serve it: finding packages and compilers takes longer than a small image."""

    def __init__(self, backend: Backend) -> None:
        self._backend, self._served = backend, set[Needs]()

    def require(self, gaussians: Gaussians, effects: Effects) -> None:
        """Raise BackendUnavailable, an ImportError, with every reason why the backend cannot draw and differentiate `gaussians`."""
        needs = Needs.of(gaussians, effects, gradients=True)
        if needs not in self._served:
            if reasons := self._backend.lacking(needs):
                raise BackendUnavailable(f"backend {self._backend.name!r} cannot do this: {'; '.join(reasons)}")
            self._served.add(needs)


def at_the_origin(camera: Camera) -> Camera:
    """The camera moved to the origin, with the same rotation."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = camera.viewmat[:3, :3]
    return camera.looking_from(viewmat, camera.name)


def finite_splats(gaussians: Gaussians) -> Gaussians:
    """The splats whose every number is finite; a single NaN can spread over an image. Synchronizes with the GPU."""
    finite = finite_rows(gaussians)
    return gaussians if bool(finite.all()) else gaussians[finite]


def normalized(quats: Tensor) -> Tensor:
    """`quats` [N, 4] of norm 1, the identity where one is zero. Other rasterizers divide by the norm, which may underflow float32."""
    units = unit(quats)
    return torch.where((units == 0).all(1, keepdim=True), units.new_tensor([1.0, 0.0, 0.0, 0.0]), units)
