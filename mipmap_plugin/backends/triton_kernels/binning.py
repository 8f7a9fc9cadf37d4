"""Which splats each tile draws, front to back: one sort of the splats by depth, one stable sort of (splat, tile) pairs by tile.

Sorting by depth first leaves 16 bits of a pair to sort, where tile and depth together would be 64; ties keep the splats' own order.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from mipmap_plugin.backends.triton_kernels import PAIRS, TILE, views
from mipmap_plugin.backends.triton_kernels.records import HALF_LOG2_E, falloff

LOG2_MIN_ALPHA = views.LOG2_MIN_ALPHA

# px from a tile's edge to the outermost centers of its pixels, less some room for rounding.
EDGE = tl.constexpr(0.49)


@dataclass(frozen=True, eq=False)
class Bins:
    """The pairs, sorted by tile and then by depth."""

    members: Tensor  # [pairs] int32, the splat of each
    edges: Tensor  # [tiles + 1] int64, where a tile's pairs begin and end; behind them lie those that touch no tile after all
    rows: Tensor  # [pairs] int64, the place of each where the pairs of one splat lie side by side
    starts: Tensor  # [N] int64, where those of each splat begin
    counts: Tensor  # [N] int32, and how many they are


@triton.jit
def emit_kernel(records, boxes, starts, owners, tiles, view, count, columns, nowhere, TILE: tl.constexpr, BLOCK: tl.constexpr):
    """The tile of each pair, or `nowhere` for one in the corner of a splat's box that its ellipse leaves out."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = at < count
    owner = tl.load(owners + at, inside, 0).to(tl.int64)
    nth = (at - tl.load(starts + owner, inside, 0)).to(tl.int32)
    box = boxes + 4 * owner
    wide = tl.load(box + 2, inside, 1)
    column, row = tl.load(box, inside, 0) + nth % wide, tl.load(box + 1, inside, 0) + nth // wide
    x, y, along, shear, across, strength = falloff(records, owner, inside)
    level = tl.maximum(strength - tl.load(view + LOG2_MIN_ALPHA), 0.0)  # how far the logarithm may fall: along dy² + across u² >= -level
    across, along = tl.minimum(across, -1e-37), tl.minimum(along, -1e-37)
    # Where in the tile's rows the ellipse reaches furthest to the right, and to the left: both at `high` from the center, or at the row's edge.
    across_2, along_2 = (-1 / across) * HALF_LOG2_E, (-1 / along) * HALF_LOG2_E  # variances, px²
    tall = tl.sqrt(level / -along)
    high = shear * along_2 / tl.sqrt(across_2 + shear * shear * along_2) * tl.sqrt(level / HALF_LOG2_E)
    top, bottom = tl.maximum(row * TILE + EDGE - y, -tall), tl.minimum(row * TILE + TILE - EDGE - y, tall)
    at_right, at_left = tl.minimum(tl.maximum(high, top), bottom), tl.minimum(tl.maximum(-high, top), bottom)
    right = shear * at_right + tl.sqrt(tl.maximum(level + along * at_right * at_right, 0.0) / -across)
    left = shear * at_left - tl.sqrt(tl.maximum(level + along * at_left * at_left, 0.0) / -across)
    left_out = (top > bottom) | (x + right < column * TILE + EDGE) | (x + left > column * TILE + TILE - EDGE)
    tl.store(tiles + at, tl.where(left_out, nowhere, row * columns + column), inside)


def bins(records: Tensor, depths: Tensor, boxes: Tensor, view: Tensor, columns: int, rows: int) -> Bins:
    """Pairs of `records` [N, 9] and the tiles in their `boxes` [N, 4]. The host waits once, for the number of pairs."""
    order = depths.argsort(stable=True)
    counts = boxes[:, 3]
    ends = counts[order].cumsum(0, dtype=torch.int64)
    starts = torch.empty_like(ends).scatter_(0, order, ends - counts[order])
    pairs = int(ends[-1]) if len(ends) else 0
    owners = order.int().repeat_interleave(counts[order], output_size=pairs)
    nowhere = columns * rows
    # Radix sorts take as many passes as a key has bytes.
    tiles = torch.empty(pairs, dtype=torch.int16 if nowhere < 1 << 15 else torch.int32, device=depths.device)
    if pairs:
        grid = (triton.cdiv(pairs, PAIRS),)
        emit_kernel[grid](records, boxes, starts, owners, tiles, view, pairs, columns, nowhere, TILE=TILE, BLOCK=PAIRS)
    by_tile, places = tiles.sort(stable=True)
    edges = torch.searchsorted(by_tile, torch.arange(nowhere + 1, dtype=tiles.dtype, device=tiles.device))
    return Bins(owners[places], edges, places, starts, counts)
