"""Lists of the splats in each tile, front to back: a sort of the splats by depth, then a stable sort of (splat, tile) pairs by tile.

Sorting by depth first leaves pairs with 16-bit keys, where tile and depth together would take 64; ties keep the order of the splats.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from mipmap_plugin.backends.triton_kernels import PAIRS, views
from mipmap_plugin.backends.triton_kernels.records import HALF_LOG2_E, end_of, falloff

TILES_X, NUMBERS = views.TILES_X, views.NUMBERS

# px from a tile's edge to the outermost pixel centers, less a margin for rounding.
EDGE = tl.constexpr(0.49)


class Splatted(NamedTuple):
    """N splats in V views, as `project_kernel` writes them, and the numbers of these views."""

    records: Tensor  # [V · N, 9]
    depths: Tensor  # [V · N]
    boxes: Tensor  # [V · N, 4]
    views: Tensor


class Owned(NamedTuple):
    """The pairs of each splat side by side, for sums over them in a fixed order."""

    places: Tensor  # [pairs] int64, index of each pair in that order
    starts: Tensor  # [V · N] int64, first index of each splat
    counts: Tensor  # [V · N] int32, number of its pairs, in every fourth place


class Bins(NamedTuple):
    """(splat, tile) pairs of V views, sorted by tile and then by depth. A splat's number in view v is v · N + n, a tile's v · tiles + t."""

    splat_ids: Tensor  # [pairs] int32
    tile_offsets: Tensor  # [V · tiles + 1] int64, where each tile's pairs begin and end; pairs in no tile follow after the last
    owned: Owned | None  # None: their sums have any order


@triton.jit(do_not_specialize=["pairs", "count", "most_tiles", "no_tile", "least_key"])
def emit_kernel(records, boxes, starts, owners, tiles, shots, pairs, count, most_tiles, no_tile, least_key, TILE: tl.constexpr, BLOCK: tl.constexpr):
    """Write the tile of each pair, or `no_tile` where the splat's ellipse does not reach that tile of its box."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = at < pairs
    owner = tl.load(owners + at, inside, 0).to(tl.int64)
    nth = (at - tl.load(starts + owner, inside, 0)).to(tl.int32)
    box, number = boxes + 4 * owner, (owner // count).to(tl.int32)
    view = shots + number * NUMBERS
    wide = tl.load(box + 2, inside, 1)
    tile_x, tile_y = tl.load(box, inside, 0) + nth % wide, tl.load(box + 1, inside, 0) + nth // wide
    x, y, along, shear, across, log2_opacity = falloff(records, owner, inside)
    level = end_of(view, log2_opacity)  # inside the ellipse, along dy² + across u² >= -level
    across, along = tl.minimum(across, -1e-37), tl.minimum(along, -1e-37)
    # The dy, within the tile, at which the ellipse reaches furthest right and left: `high` and -`high`, or the tile's top or bottom.
    across_2, along_2 = (-1 / across) * HALF_LOG2_E, (-1 / along) * HALF_LOG2_E  # variances, px²
    tall = tl.sqrt(level / -along)
    high = shear * along_2 / tl.sqrt(across_2 + shear * shear * along_2) * tl.sqrt(level / HALF_LOG2_E)
    top, bottom = tl.maximum(tile_y * TILE + EDGE - y, -tall), tl.minimum(tile_y * TILE + TILE - EDGE - y, tall)
    at_right, at_left = tl.minimum(tl.maximum(high, top), bottom), tl.minimum(tl.maximum(-high, top), bottom)
    right = shear * at_right + tl.sqrt(tl.maximum(level + along * at_right * at_right, 0.0) / -across)
    left = shear * at_left - tl.sqrt(tl.maximum(level + along * at_left * at_left, 0.0) / -across)
    outside = (top > bottom) | (x + right < tile_x * TILE + EDGE) | (x + left > tile_x * TILE + TILE - EDGE)
    tile = number * most_tiles + tile_y * tl.load(view + TILES_X).to(tl.int32) + tile_x
    tl.store(tiles + at, tl.where(outside, no_tile, tile) - least_key, inside)


def bin_splats(splatted: Splatted, most_tiles: int, tile: int, fixed_order: bool, most_pairs: float = math.inf) -> Bins | None:
    """Pair splats with the tiles in their boxes; None if there are more than `most_pairs`. The host synchronizes once, for the number of pairs.

    most_tiles: of a view. tile: px. fixed_order: whether sums over the pairs of a splat will have one.
    """
    records, depths, boxes, shots = splatted
    order = depths.argsort(stable=True)
    counts = boxes[:, 3]
    in_order = counts[order]
    ends = in_order.cumsum(0, dtype=torch.int64)
    starts = torch.empty_like(ends).scatter_(0, order, ends - in_order)
    pairs = int(ends[-1]) if len(ends) else 0
    if pairs > most_pairs:
        return None
    owners = order.int().repeat_interleave(in_order, output_size=pairs)
    no_tile = len(shots) * most_tiles
    # A radix sort takes one pass per byte of the key. Torch has no sort for unsigned ones.
    key, least_key = (torch.int16, 1 << 15) if no_tile < 1 << 16 else (torch.int32, 0)
    tiles = torch.empty(pairs, dtype=key, device=depths.device)
    if pairs:
        grid, count = (triton.cdiv(pairs, PAIRS),), len(records) // len(shots)
        emit_kernel[grid](records, boxes, starts, owners, tiles, shots, pairs, count, most_tiles, no_tile, least_key, TILE=tile, BLOCK=PAIRS)
    by_tile, places = tiles.sort(stable=True)
    keys = torch.arange(-least_key, no_tile + 1 - least_key, dtype=key, device=tiles.device)
    tile_offsets = torch.searchsorted(by_tile, keys)
    return Bins(owners[places], tile_offsets, Owned(places, starts, counts) if fixed_order else None)
