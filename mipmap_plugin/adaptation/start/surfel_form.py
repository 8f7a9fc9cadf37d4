"""The closed form of surfels, whose screen filter does not widen them but sets a minimum size.

A pixel shows the larger of the surfel and of a low-pass filter of e px² (`splatting.surfels`). At scale s the filter of the adapted file
is e px² of the target, while that of the base measured e·s² of them. Zoom-in: the base's filter, which the file no longer has, becomes
the surfel's minimum size. Zoom-out: no surfel can be smaller than the file's filter, so that its opacity is divided by the area that
the filter adds.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mipmap_plugin.splatting.projection import Projected

# A surfel that views see at a slant covers less than the filter did. It is enlarged for that by at most this factor of its area, because a
# larger one stands out in views from the front.
MAX_WIDENING = 2.0


def widened_to_filter(scales: Tensor, pixel: Tensor, eps2d: float) -> Tensor:
    """Scales [N, 3] whose first two are at least as wide as a filter of `eps2d` px², for pixels of size `pixel` [N] (world units)."""
    wide = scales[:, :2].maximum((eps2d**0.5 * pixel)[:, None])
    return torch.cat([wide, scales[:, 2:]], dim=1)


def widened_for_slant(scales: Tensor, wide: Tensor, area_ratio: Tensor) -> Tensor:
    """Enlarge the axes of `wide` [N, 3] that are wider than in `scales`, so that the area grows by `area_ratio` [N], which slant removes."""
    widened = wide > scales
    factor = area_ratio.clamp(1, MAX_WIDENING)[:, None] ** (1 / widened.sum(1, keepdim=True).clamp_min(1))
    return torch.where(widened, wide * factor, wide)


def visible_area(projected: Projected, eps2d: float) -> Tensor:
    """Visible area of each splat, [N] in px², without the factor 2π: the integral over the screen of the larger of two Gaussians.

    One is the splat's, the other the filter's, of variance `eps2d`; both are 1 at the center. In polar coordinates each is a Gaussian of
    the radius, and along each direction the one of larger variance is the larger. With standard deviations a >= f >= b of the splat's axes
    and of the filter, the splat's is the larger within an angle t of its long axis, where tan² t = (1/f² - 1/a²) / (1/b² - 1/f²), and
    both parts have closed-form integrals:

        area = (2/π)·(a·b·atan(tan(t)·a/b) + f²·(π/2 - t)).
    """
    tiny = torch.finfo(projected.det.dtype).tiny
    mean, half_difference = (projected.xx + projected.yy) / 2, torch.hypot((projected.xx - projected.yy) / 2, projected.xy)
    longer = mean + half_difference
    shorter = projected.det / longer.clamp_min(tiny)
    a2, b2 = longer.clamp_min(eps2d), shorter.clamp(tiny, eps2d)  # the formula then holds for all splats except those wider than the filter
    tangent = ((1 / eps2d - 1 / a2) / (1 / b2 - 1 / eps2d).clamp_min(tiny)).clamp_min(0).sqrt()
    splat_part = (a2 * b2).sqrt() * torch.atan(tangent * (a2 / b2).sqrt())
    area = 2 / math.pi * (splat_part + eps2d * (math.pi / 2 - torch.atan(tangent)))
    return torch.where(shorter > eps2d, projected.det.sqrt(), area)
