"""One program draws one tile: its splats one after the other, front to back, until no pixel is open.

Where there are many tiles a program is a single warp, whose lanes hold eight pixels each: what a splat is need be read once for all of
them, the eight hide one another's latency, and sums over the tile need no barrier.
"""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin import effects
from mipmap_plugin.backends.triton_kernels import views
from mipmap_plugin.backends.triton_kernels.records import RECORD

MAX_ALPHA = tl.constexpr(effects.MAX_ALPHA)
MIN_ALPHA, MIN_THROUGH = views.MIN_ALPHA, views.MIN_THROUGH
RED, GREEN, BLUE = views.RED, views.GREEN, views.BLUE


@triton.jit
def pixels(columns, width, height, TILE: tl.constexpr):
    """Centers in px and index in the image of this program's pixels [TILE²], and which of them lie in it."""
    tile = tl.program_id(0)
    nth = tl.arange(0, TILE * TILE)
    x, y = tile % columns * TILE + nth % TILE, tile // columns * TILE + nth // TILE
    return x + 0.5, y + 0.5, (y * width + x).to(tl.int64), (x < width) & (y < height)


@triton.jit
def member(records, members, slot, end):
    """The splat at a slot and its record; behind the end the last one's, which then has to be taken for invisible."""
    splat = tl.load(members + tl.minimum(slot, end - 1)).to(tl.int64)
    return splat, records + splat * RECORD


@triton.jit
def alpha_at(row, there, px, py, least):
    """Of the record `row` at the pixels [P]: dy, dx - shear · dy, and alpha before and after its cut-offs."""
    dy = py - tl.load(row + 1)
    u = px - tl.load(row) - tl.load(row + 3) * dy
    strength = tl.where(there, tl.load(row + 5), float("-inf"))
    raw = tl.exp2(tl.load(row + 2) * dy * dy + tl.load(row + 4) * u * u + strength)
    return dy, u, raw, tl.where(raw >= least, tl.minimum(raw, MAX_ALPHA), 0.0)


@triton.jit
def composite_kernel(records, members, edges, view, image, through, columns, width, height, TILE: tl.constexpr, BATCH: tl.constexpr):
    px, py, at, inside = pixels(columns, width, height, TILE)
    slot, end = tl.load(edges + tl.program_id(0)), tl.load(edges + tl.program_id(0) + 1)
    least, stop = tl.load(view + MIN_ALPHA), tl.load(view + MIN_THROUGH)
    run = tl.where(inside, 1.0, 0.0)  # light that would be left if pixels never stopped: below `stop` one is finished for good
    left = tl.zeros_like(run) + 1  # light that is left
    red, green, blue = tl.zeros_like(run), tl.zeros_like(run), tl.zeros_like(run)
    while (slot < end) & (tl.max(run, axis=0) >= stop):
        for _ in tl.static_range(BATCH):
            _, row = member(records, members, slot, end)
            _, _, _, alpha = alpha_at(row, slot < end, px, py, least)
            behind = run * (1 - alpha)
            weight = tl.where(behind >= stop, run * alpha, 0.0)
            red += weight * tl.load(row + 6)
            green += weight * tl.load(row + 7)
            blue += weight * tl.load(row + 8)
            left = tl.where(behind >= stop, behind, left)
            run = behind
            slot += 1
    tl.store(image + 3 * at, red + left * tl.load(view + RED), inside)
    tl.store(image + 3 * at + 1, green + left * tl.load(view + GREEN), inside)
    tl.store(image + 3 * at + 2, blue + left * tl.load(view + BLUE), inside)
    tl.store(through + at, left, inside)
