"""Thinning: rows that networks decode, such as anchors, cannot be merged, but some can be left out, for others to learn to show what they did.

At zoom-out the screen filter makes every splat wider, so that many are too opaque together. Fewer of them show about the right depth, before any
opacity is learned, and take less time.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mipmap_plugin.adaptation.start.merging import along_curve
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.models.base import SplatModel

# At least so many splats per target pixel stay. An object that has 5 to 15 of them after thinning loses nothing by it at x1/2 to x1/8; small scenes
# that have 1.3 before it lose 4 to 9 dB.
PER_PIXEL = 3.0

# Views in which splats are counted.
COUNTED = 4


@torch.no_grad()
def least_fraction(model: SplatModel, views: Sequence[Camera], scale: float) -> float:
    """The least fraction of a model's rows that leaves enough splats a pixel; 1 or more: none can be left out. `views`: of the base scale."""
    zoomed = [view.zoomed(scale) for view in evenly(views, COUNTED)]
    return PER_PIXEL * sum(view.width * view.height for view in zoomed) / max(1, sum(len(model.gaussians(view)) for view in zoomed))


def evenly_in_space(means: Tensor, pixel: Tensor, fraction: float) -> Tensor:
    """[N] bool: a `fraction` (0..1) of the `means` [N, 3], spread as all of them are: those at equal intervals along a curve through them.

    `pixel` [N]: the size of a target pixel at each, in world units.
    """
    order = along_curve(means, pixel.median(), torch.zeros(3))
    passed = torch.arange(len(order) + 1, device=order.device, dtype=torch.float64).mul_(fraction).floor_()
    return torch.zeros_like(order, dtype=torch.bool).index_fill_(0, order[passed.diff() > 0], True)
