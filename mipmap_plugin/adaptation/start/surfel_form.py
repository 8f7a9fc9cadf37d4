"""The closed form of surfels, whose screen filter does not widen them but puts a least size of its own beside them.

A surfel shows the larger of itself and of a low-pass filter of e px² (`splatting.surfels`). At scale s the file's filter is e px² of the
target, where the base showed e·s² of them. Zoom-in: the base's filter, which the file no longer has, becomes the surfel's least size.
Zoom-out: nothing can become smaller than the file's filter, so that opacity falls by the area that this one adds.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mipmap_plugin.splatting.projection import Projected

# A surfel that views see at a slant shows less than the filter did; with more than so many times its area it stands out where it is met from
# the front (lego at x2, its splats made flat: 28.4 dB from the base; 28.0 at 1, 28.2 from 4 on).
MOST_WIDER = 2.0


def least_sizes(scales: Tensor, pixel: Tensor, eps2d: float) -> Tensor:
    """Scales [N, 3] of which the first two are at least as wide as a filter of `eps2d` px², of pixels of size `pixel` [N] (world units)."""
    wide = scales[:, :2].maximum((eps2d**0.5 * pixel)[:, None])
    return torch.cat([wide, scales[:, 2:]], dim=1)


def lay_out(scales: Tensor, wide: Tensor, lost: Tensor) -> Tensor:
    """`wide` [N, 3], larger where it is wider than `scales` already, so that the areas that are `lost` [N] at a slant are shown again."""
    widened = wide > scales
    share = lost.clamp(1, MOST_WIDER)[:, None] ** (1 / widened.sum(1, keepdim=True).clamp_min(1))
    return torch.where(widened, wide * share, wide)


def shown_area(projected: Projected, eps2d: float) -> Tensor:
    """[N] px², up to 2π: the integral over the screen of the larger of a splat's Gaussian and of one of variance `eps2d`, both 1 in the middle.

    In polar coordinates both fall off as a Gaussian of r, whose variance along the direction is the larger of the two. With deviations
    a >= f >= b of the splat's axes and of the filter the splat's is the larger within an angle t of its long axis, where
    tan² t = (1/f² - 1/a²) / (1/b² - 1/f²), and the integrals of both parts are known:

        area = (2/π)·(a·b·atan(tan(t)·a/b) + f²·(π/2 - t)).
    """
    tiny = torch.finfo(projected.det.dtype).tiny
    middle, apart = (projected.xx + projected.yy) / 2, torch.hypot((projected.xx - projected.yy) / 2, projected.xy)
    longer = middle + apart
    shorter = projected.det / longer.clamp_min(tiny)
    a2, b2 = longer.clamp_min(eps2d), shorter.clamp(tiny, eps2d)  # with which the formula holds for any of them but the widest
    tangent = ((1 / eps2d - 1 / a2) / (1 / b2 - 1 / eps2d).clamp_min(tiny)).clamp_min(0).sqrt()
    own = (a2 * b2).sqrt() * torch.atan(tangent * (a2 / b2).sqrt())
    beside = 2 / math.pi * (own + eps2d * (math.pi / 2 - torch.atan(tangent)))
    return torch.where(shorter > eps2d, projected.det.sqrt(), beside)
