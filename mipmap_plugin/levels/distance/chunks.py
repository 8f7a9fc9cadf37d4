"""Chunks: the boxes that a streaming viewer chooses a level for, as splat-transform cuts a scene and PlayCanvas measures their distance."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.formats.streamed_sog import SMALLEST_CHUNK
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.projection import axes_of

# Splats of a chunk, of all levels together, that splat-transform does not cut any further, whatever its size.
LEAST = 1024 * SMALLEST_CHUNK

# The same of the base alone, before there are levels: a ladder has some times as many.
LEAST_OF_BASE = LEAST // 4

# PlayCanvas's `lodDistanceShrink`: a side of a chunk's box that is longer than the median chunk's loses this fraction of the difference before
# distances are measured. Otherwise a few large splats would make a box so long that a camera is always inside.
SHRINK = 0.75


@dataclass(frozen=True, eq=False)
class Chunks:
    """Chunks of a scene: a binary tree of cuts, and a box around each leaf."""

    cuts: list[tuple[int, float, int, int]]  # axis, place, then two children: a cut, or -1 - chunk
    low: Tensor  # [C, 3] world units, of the box that distances are measured to
    high: Tensor  # [C, 3]

    @classmethod
    def of(cls, gaussians: Gaussians, extent: float, least: int = LEAST) -> Chunks:
        """Cut splats of all levels at the median of their longest side until a chunk measures at most `extent` or has at most `least`.

        A box holds its splats up to one standard deviation, as splat-transform's do, less what PlayCanvas shrinks it by.
        """
        reach = axes_of(gaussians.quats, gaussians.scales).abs().sum(2)
        means, cuts, leaves = gaussians.means, list[tuple[int, float, int, int]](), list[Tensor]()

        def cut(rows: Tensor) -> int:
            sides = means[rows].amax(0) - means[rows].amin(0)
            axis = int(sides.argmax())
            if len(rows) <= least or sides[axis] <= extent:
                leaves.append(rows)
                return -len(leaves)
            place = float(means[rows, axis].kthvalue(len(rows) // 2).values)
            below = means[rows, axis] <= place
            if below.all():  # more than half lie in one plane: no cut can part them
                leaves.append(rows)
                return -len(leaves)
            number = len(cuts)
            cuts.append((0, 0.0, 0, 0))
            cuts[number] = (axis, place, cut(rows[below]), cut(rows[~below]))
            return number

        cut(torch.arange(len(means), device=means.device))
        lows, highs = means - reach, means + reach
        low = torch.stack([lows[rows].amin(0) for rows in leaves])
        high = torch.stack([highs[rows].amax(0) for rows in leaves])
        return cls(cuts, *shrunk(low, high))

    def __len__(self) -> int:
        return len(self.low)

    def of_points(self, means: Tensor) -> Tensor:
        """The chunk of each point [N, 3]: [N] int64."""
        found = torch.zeros(len(means), dtype=torch.long, device=means.device)
        todo = [(0 if self.cuts else -1, torch.arange(len(means), device=means.device))]
        while todo:
            node, rows = todo.pop()
            if node < 0:
                found[rows] = -1 - node
                continue
            axis, place, below, above = self.cuts[node]
            is_below = means[rows, axis] <= place
            todo += [(below, rows[is_below]), (above, rows[~is_below])]
        return found

    def distances(self, eye: Tensor) -> Tensor:
        """The distance from the eye [3] to the nearest point of each box, [C]; 0 inside."""
        return box_distances(self.low, self.high, eye.to(self.low))


def box_distances(low: Tensor, high: Tensor, eyes: Tensor) -> Tensor:
    """The distance from eyes [..., 3] to the nearest point of each box between corners [C, 3], [..., C]; 0 inside."""
    eyes = eyes[..., None, :]
    away: Tensor = torch.maximum(low - eyes, eyes - high).clamp_min(0).norm(dim=-1)
    return away


def shrunk(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """The boxes that PlayCanvas measures distances to, as corners [C, 3], from those of the chunks' own boxes [C, 3] (`SHRINK`)."""
    middle, half = (low + high) / 2, (high - low) / 2
    usual = half.sort(dim=0).values[len(half) // 2]
    half = half - SHRINK * (half - usual).clamp_min(0)
    return middle - half, middle + half
