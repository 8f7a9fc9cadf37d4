"""What the rasterizers of other projects have in common: how splats are put before they are handed over."""

from __future__ import annotations

import torch
from torch import Tensor

from mipmap_plugin.backends.reference import finite_rows
from mipmap_plugin.gaussians import Gaussians

NO_CUDA = "it needs a CUDA GPU, and torch sees none here"
UNTRIED = "never run on a GPU by this package's author"


def sound(gaussians: Gaussians) -> Gaussians:
    """The splats whose every number is finite; one broken splat can blacken an image. The host waits for the answer."""
    finite = finite_rows(gaussians)
    return gaussians if bool(finite.all()) else gaussians[finite]


def turned(quats: Tensor) -> Tensor:
    """`quats` [N, 4] with the identity where one is zero; others would divide by its length."""
    zero = (quats == 0).all(1, keepdim=True)
    return torch.where(zero, quats.new_tensor([1.0, 0.0, 0.0, 0.0]), quats)
