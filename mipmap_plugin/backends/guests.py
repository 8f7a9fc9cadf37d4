"""What backends for GPUs have in common: what they ask for first, and how splats are put before other projects' rasterizers get them."""

from __future__ import annotations

import torch
from torch import Tensor

from mipmap_plugin.backends.base import Backend, Needs
from mipmap_plugin.backends.reference import finite_rows
from mipmap_plugin.errors import BackendUnavailable
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.rotations import unit

NO_CUDA = "it needs a CUDA GPU, and torch sees none here"
UNTRIED = "never run on a GPU by this package's author"


class Asked:
    """Asks a backend what it lacks once for each kind of request: looking for packages and compilers takes longer than drawing a small image."""

    def __init__(self, backend: Backend) -> None:
        self._backend, self._served = backend, set[Needs]()

    def refuse(self, needs: Needs) -> None:
        """Raises BackendUnavailable, an ImportError, with every reason why the backend cannot serve `needs`."""
        if needs in self._served:
            return
        reasons = self._backend.lacking(needs)
        if reasons:
            raise BackendUnavailable(f"backend {self._backend.name!r} cannot do this: {'; '.join(reasons)}")
        self._served.add(needs)


def sound(gaussians: Gaussians) -> Gaussians:
    """The splats whose every number is finite; one broken splat can blacken an image. The host waits for the answer."""
    finite = finite_rows(gaussians)
    return gaussians if bool(finite.all()) else gaussians[finite]


def turned(quats: Tensor) -> Tensor:
    """`quats` [N, 4] of norm 1, with the identity where one is zero; others would divide by a length that float32 does not hold."""
    turns = unit(quats)
    return torch.where((turns == 0).all(1, keepdim=True), turns.new_tensor([1.0, 0.0, 0.0, 0.0]), turns)
