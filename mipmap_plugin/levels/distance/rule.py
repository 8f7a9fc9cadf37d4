"""PlayCanvas's rule: which level of a chunk a camera sees.

A chunk at distance d, times the tangent of half the smaller field of view over that of 22.5°, is shown at level 0 up to `lodBaseDistance`, and at
level k up to `lodBaseDistance · lodMultiplier^k`. A pixel there is d / f world units wide, f the focal length in px, whatever the canvas: so this is
a rule for *the size of a pixel in the world*, and a level is made for one such size. For a splat whose closest training view had pixels of size p,
a level for pixels of size q is at the scale p / q: a near flower at x1/4, say, where a far mountain is still at x1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.adaptation.views.pixel_size import nearest
from mipmap_plugin.camera import Camera
from mipmap_plugin.levels.request import Band, LadderRequest


@dataclass(frozen=True)
class DistanceRule:
    """Which level is shown where a pixel has which size, in world units."""

    first: float  # level 0 is shown up to this size of a pixel
    ratio: float  # level k up to first · ratio^k
    count: int  # the number of levels, level 0 included; the last is shown at any larger size
    left_out: int = 0  # the number of further levels that were made and left out; the last is shown in their place

    @classmethod
    def of(cls, pixels: Tensor, request: LadderRequest, band: Band) -> DistanceRule:
        """The rule for splats that training saw with pixels of these sizes [N], at least one. `band`: the zooms that level 0 was adapted to.

        The nearest parts of the scene leave level 0 where its band ends; the last level is the one that has them at the coarsest scale.
        """
        near = nearest(pixels)
        first = near / band.low
        steps = math.log(near / request.coarsest / first) / math.log(band.ratio)
        return cls(first, band.ratio, 1 if band.reaches(request.coarsest) else 1 + max(1, math.ceil(steps - 1e-6)))

    def level(self, pixels: Tensor) -> Tensor:
        """The level that is shown where pixels have these sizes; int64 of the same shape."""
        steps = torch.log(pixels.double().clamp_min(torch.finfo(torch.float64).tiny) / self.first) / math.log(self.ratio)
        return (steps.floor() + 1).clamp(0, self.count - 1).long()

    def ends(self, level: int) -> tuple[float, float]:
        """The sizes of a pixel from which and up to which a level is made."""
        return (self.first * float(self.ratio ** (level - 1)) if level else 0.0), self.first * float(self.ratio**level)

    def middle(self, level: int) -> float:
        """The size of a pixel that a level is merged for: the middle of its ends in the logarithm, if level 0 counts as wide as the others."""
        return self.first * float(self.ratio ** (level - 0.5))

    def playcanvas(self, canvas: int) -> tuple[float, float]:
        """`lodBaseDistance` and `lodMultiplier` for a canvas whose shorter side has so many px."""
        return canvas / 2 / math.tan(math.pi / 8) * self.first, self.ratio


def focal_along_shorter_side(camera: Camera) -> float:
    """The focal length in px along the shorter side, which the rule is about."""
    return camera.fx if camera.width <= camera.height else camera.fy
