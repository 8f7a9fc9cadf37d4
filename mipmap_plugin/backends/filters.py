"""Screen filters: what is added to a projected splat so that a pixel grid can carry it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.backends.projection import Projected

# The least share of its opacity that compensation leaves to a splat (dr_aa, gsplat 1.6): without it, flat and needle-shaped
# splats, whose projected area is almost zero, would vanish from the image and from the gradient.
MIN_COMPENSATION = 0.005


@dataclass(frozen=True, eq=False)
class Footprint:
    """A splat as the pixels see it: alpha = opacity · exp(-q/2) with q = dy²/yy + (dx - shear·dy)²/across.

    The two squares are the Cholesky factor of the conic; a sum of squares keeps its accuracy for needles, where the usual
    a·dx² + 2b·dx·dy + c·dy² cancels.
    """

    yy: Tensor  # [N] px², variance along y
    shear: Tensor  # [N] px/px, how far the ridge moves in x per px in y
    across: Tensor  # [N] px², variance along x at a given y
    xx: Tensor  # [N] px², variance along x
    opacities: Tensor  # [N]


def footprint(projected: Projected, opacities: Tensor, screen_filter: str, eps2d: float) -> Footprint:
    """Dilate by `eps2d` px²; "antialiased" also scales the opacity so that the splat's light stays what it was."""
    xx, yy = projected.xx + eps2d, projected.yy + eps2d
    det = projected.det + eps2d * (projected.xx + projected.yy) + eps2d**2  # = xx·yy - xy² without its cancellation
    if screen_filter == "antialiased":
        opacities = opacities * (projected.det / det).clamp_min(MIN_COMPENSATION**2).sqrt()
    return Footprint(yy, projected.xy / yy, det / yy, xx, opacities)


SCREEN_FILTERS = frozenset({"classic", "antialiased"})


def scaled_eps2d(eps2d: float, scale: float) -> float:
    """The training-free filter of SA-GS: the dilation keeps the size that it had in the world (METHODS: Σ₂D·s² + eps2d·s²)."""
    return eps2d * scale**2


def visible(feet: Footprint, min_alpha: float) -> Tensor:
    """[N] bool: finite, and bright enough to reach `min_alpha` somewhere."""
    finite = torch.isfinite(torch.stack([feet.yy, feet.shear, feet.across, feet.xx, feet.opacities])).all(0)
    return finite & (feet.opacities >= min_alpha) & (feet.across > 0)
