"""Cuts by position: every splat lies in exactly one core, and all cores have the same number of splats, give or take one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

# The extent of a set of splats along an axis leaves out this fraction at either end, so that a few far ones do not decide where it is cut.
STRAYS = 0.02

# The number of a core, or (axis, place, the tree of what lies below that place, the tree of what lies above).
Tree = int | tuple[int, float, Any, Any]


def cut(means: Tensor, rows: Tensor, count: int, first: int = 0) -> tuple[list[Tensor], Tree]:
    """Cut `rows` [M] of splats at `means` [N, 3] into `count` cores, by planes across the longest axis (a k-d tree; Bentley 1975).

    The rows of each core keep their order. The tree has the cores' numbers, from `first` on.
    """
    if count == 1:
        return [rows], first
    places = means[rows]
    low = count // 2
    size = len(rows) * low // count
    axis = _longest_axis(places)
    order = places[:, axis].argsort(stable=True)
    at = float(places[order[size - 1 : size + 1], axis].double().mean())
    below, low_tree = cut(means, rows[order[:size].sort().values], low, first)
    above, high_tree = cut(means, rows[order[size:].sort().values], count - low, first + low)
    return [*below, *above], (axis, at, low_tree, high_tree)


def front_to_back(tree: Tree, center: Sequence[float]) -> list[int]:
    """The cores as a camera at `center` sees them: on no line of sight is a point of a core in front of one of a core before it.

    (Binary space partitioning: what lies on the camera's side of a plane hides what lies beyond; Fuchs, Kedem and Naylor 1980.)
    """
    if isinstance(tree, int):
        return [tree]
    axis, at, below, above = tree
    near, far = (below, above) if center[axis] <= at else (above, below)
    return [*front_to_back(near, center), *front_to_back(far, center)]


def _longest_axis(places: Tensor) -> int:
    low, high = (max(1, min(len(places), round(len(places) * share))) for share in (STRAYS, 1 - STRAYS))
    lengths = places.kthvalue(high, dim=0).values - places.kthvalue(low, dim=0).values
    return int(torch.argmax(lengths))
