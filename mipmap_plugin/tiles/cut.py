"""Cuts by position: every splat lies in exactly one core, and all cores have the same number of splats, give or take one."""

from __future__ import annotations

import torch
from torch import Tensor

# The extent of a set of splats along an axis leaves out this fraction at either end, so that a few far ones do not decide where it is cut.
STRAYS = 0.02


def cut(means: Tensor, rows: Tensor, count: int) -> list[Tensor]:
    """Cut `rows` [M] of splats at `means` [N, 3] into `count` cores, by planes across the longest axis (a k-d tree; Bentley 1975).

    The rows of each core keep their order.
    """
    if count == 1:
        return [rows]
    places = means[rows]
    first = count // 2
    size = len(rows) * first // count
    along = places[:, _longest_axis(places)]
    order = along.argsort(stable=True)
    return [*cut(means, rows[order[:size].sort().values], first), *cut(means, rows[order[size:].sort().values], count - first)]


def _longest_axis(places: Tensor) -> int:
    low, high = (max(1, min(len(places), round(len(places) * share))) for share in (STRAYS, 1 - STRAYS))
    lengths = places.kthvalue(high, dim=0).values - places.kthvalue(low, dim=0).values
    return int(torch.argmax(lengths))
