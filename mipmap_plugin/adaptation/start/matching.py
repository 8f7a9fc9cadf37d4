"""Opacities that give each splat the blend weight that it had in the base's images.

A dilated splat covers a larger area, and the closed form lowers its opacity by the same factor; at zoom-in it raises it. But the coverage
of overlapping splats is not the sum of their areas, and splats behind them shine through more. Both are corrected by measuring the blend
weight of each splat in the target's images, and multiplying its opacity by the ratio of the wanted to the measured weight: iterative
proportional fitting (Deming and Stephan 1940), damped where it overshoots.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

# Iterations. Where no step follows, as many again are tried: captures gain up to 1.2 dB by them, lego 1.5.
ROUNDS = 3

# An opacity changes by at most this factor per iteration.
MAX_FACTOR = 4.0

# Pixels: an invisible blend weight, added to keep ratios finite.
INVISIBLE_WEIGHT = 1e-4

# Fraction of the weight that a splat would have if nothing hid it, added too: what shows of hidden splats, or at the edge of a view, says little
# of their opacities. A capture of which one side is shown keeps 1 dB more of the others by it.
HARDLY_SEEN = 1e-3


@torch.no_grad()
def matched_opacities(opacities: Tensor, target: Tensor, whole: Tensor, weights_of: Callable[[Tensor], Tensor], rounds: int = ROUNDS) -> Tensor:
    """Opacities [N] for which `weights_of(opacities)`, the mean blend weight [N] of each splat in pixels, is close to `target` [N].

    `whole` [N]: the weights of splats that nothing hides (`blend_weights.whole_weights`).
    """
    known, before = INVISIBLE_WEIGHT + HARDLY_SEEN * whole, None
    for _ in range(rounds):
        ratio = (target + known) / (weights_of(opacities) + known)
        overshot = torch.zeros_like(ratio, dtype=torch.bool) if before is None else (ratio > 1) != (before > 1)
        factor = torch.where(overshot, ratio.sqrt(), ratio).to(opacities)  # half of the way, as factors go
        opacities, before = (opacities * factor.clamp(1 / MAX_FACTOR, MAX_FACTOR)).clamp_max(1), ratio
    return opacities
