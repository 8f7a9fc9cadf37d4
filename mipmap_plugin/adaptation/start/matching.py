"""Opacities that give each splat the blend weight that it had in the base's images.

A splat that was dilated covers more, and its opacity is less by as much; but what several of them cover together is not the sum of
what each does, and what lay hidden behind them shines through. Both are put right by asking what each splat adds to the target's
images, and changing its opacity by the ratio to what it should: iterative proportional fitting (Deming and Stephan 1940).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

# Rounds: the first gains most; a fourth changes nothing that is seen.
ROUNDS = 3

# A splat's opacity changes by no more than this factor in a round.
MOST = 4.0

# Pixels: a blend weight of which nothing is seen, which keeps the ratio of two of them finite.
UNSEEN = 1e-4


@torch.no_grad()
def matched(opacities: Tensor, wanted: Tensor, weigh: Callable[[Tensor], Tensor]) -> Tensor:
    """Opacities [N] with which `weigh(opacities)`, the mean blend weight [N] of each splat in pixels of a view, comes close to `wanted` [N]."""
    for _ in range(ROUNDS):
        ratio = (wanted + UNSEEN) / (weigh(opacities) + UNSEEN)
        opacities = (opacities * ratio.to(opacities).clamp(1 / MOST, MOST)).clamp_max(1)
    return opacities
