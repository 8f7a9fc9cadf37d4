"""Opacities that give each splat the blend weight that it had in the base's images.

A dilated splat covers a larger area, and the closed form lowers its opacity by the same factor. But the coverage of overlapping splats
is not the sum of their areas, and splats behind them shine through more. Both are corrected by measuring the blend weight of each splat
in the target's images, and multiplying its opacity by the ratio of the wanted to the measured weight: iterative proportional fitting
(Deming and Stephan 1940).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

# Iterations: the first gains most; a fourth makes no visible difference.
ROUNDS = 3

# An opacity changes by at most this factor per iteration.
MAX_FACTOR = 4.0

# Pixels: an invisible blend weight, added to keep ratios finite.
INVISIBLE_WEIGHT = 1e-4


@torch.no_grad()
def matched_opacities(opacities: Tensor, target: Tensor, weights_of: Callable[[Tensor], Tensor]) -> Tensor:
    """Opacities [N] for which `weights_of(opacities)`, the mean blend weight [N] of each splat in pixels, is close to `target` [N]."""
    for _ in range(ROUNDS):
        ratio = (target + INVISIBLE_WEIGHT) / (weights_of(opacities) + INVISIBLE_WEIGHT)
        opacities = (opacities * ratio.to(opacities).clamp(1 / MAX_FACTOR, MAX_FACTOR)).clamp_max(1)
    return opacities
