"""The gradients of a tile's pixels, back to the records of its splats: the same way front to back as the image was drawn.

What lies behind a splat is what the image holds less what lies in front, so that nothing but the image need be kept, and no light is
recovered by division. The sums over a tile's pixels go to the splats by atomic additions, or, where the order of sums must be the same
each time, to one row for each pair, which `gather_kernel` adds up in the pairs' order.
"""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin.backends.triton_kernels import views
from mipmap_plugin.backends.triton_kernels.compositing import MAX_ALPHA, alpha_at, member, pixels
from mipmap_plugin.backends.triton_kernels.records import LN_2, RECORD
from mipmap_plugin.backends.triton_kernels.vectors import load3

MIN_ALPHA, MIN_THROUGH = views.MIN_ALPHA, views.MIN_THROUGH


@triton.jit
def put(at, value, DETERMINISTIC: tl.constexpr):
    """A sum over a tile's pixels at `at`: alone there, or added to those of other tiles."""
    if DETERMINISTIC:
        tl.store(at, value)
    else:
        tl.atomic_add(at, value, sem="relaxed")


@triton.jit
def composite_back_kernel(
    records, members, edges, places, view, image, through, d_image, d_alpha, pulls, columns, width, height,
    TILE: tl.constexpr, BATCH: tl.constexpr, DETERMINISTIC: tl.constexpr,
):  # fmt: skip
    px, py, at, inside = pixels(columns, width, height, TILE)
    slot, end = tl.load(edges + tl.program_id(0)), tl.load(edges + tl.program_id(0) + 1)
    least, stop = tl.load(view + MIN_ALPHA), tl.load(view + MIN_THROUGH)
    run = tl.where(inside, 1.0, 0.0)
    d_red, d_green, d_blue = load3(d_image + 3 * at, inside)
    red, green, blue = load3(image + 3 * at, inside)
    # What the splats from here on and the background add to the loss; alpha's own share lies all the way behind.
    rest = d_red * red + d_green * green + d_blue * blue - tl.load(d_alpha + at, inside, 0.0) * tl.load(through + at, inside, 0.0)
    while (slot < end) & (tl.max(run, axis=0) >= stop):
        for _ in tl.static_range(BATCH):
            splat, row = member(records, members, slot, end)
            dy, u, raw, alpha = alpha_at(row, slot < end, px, py, least)
            behind = run * (1 - alpha)
            weight = tl.where(behind >= stop, run * alpha, 0.0)
            if tl.max(weight, axis=0) > 0:
                shine = d_red * tl.load(row + 6) + d_green * tl.load(row + 7) + d_blue * tl.load(row + 8)
                rest -= weight * shine
                # d loss / d log2 alpha: alpha · d alpha, and nothing where alpha was cut off or the pixel had stopped.
                pull = (weight * shine - alpha / (1 - alpha) * rest) * LN_2
                pull = tl.where((weight > 0) & (raw <= MAX_ALPHA), pull, 0.0)
                to_u = -2 * tl.load(row + 4) * tl.sum(pull * u, axis=0)
                to_y = -2 * tl.load(row + 2) * tl.sum(pull * dy, axis=0) - tl.load(row + 3) * to_u
                out = pulls + (tl.load(places + slot) if DETERMINISTIC else splat) * RECORD
                put(out, to_u, DETERMINISTIC)
                put(out + 1, to_y, DETERMINISTIC)
                put(out + 2, tl.sum(pull * dy * dy, axis=0), DETERMINISTIC)
                put(out + 3, -2 * tl.load(row + 4) * tl.sum(pull * u * dy, axis=0), DETERMINISTIC)
                put(out + 4, tl.sum(pull * u * u, axis=0), DETERMINISTIC)
                put(out + 5, tl.sum(pull, axis=0), DETERMINISTIC)
                put(out + 6, tl.sum(weight * d_red, axis=0), DETERMINISTIC)
                put(out + 7, tl.sum(weight * d_green, axis=0), DETERMINISTIC)
                put(out + 8, tl.sum(weight * d_blue, axis=0), DETERMINISTIC)
            run = behind
            slot += 1


@triton.jit
def gather_kernel(partial, starts, counts, pulls, ROWS: tl.constexpr):
    """The sum of one splat's rows, `ROWS` at a time in their order. One splat a program."""
    splat = tl.program_id(0).to(tl.int64)
    begin, count = tl.load(starts + splat), tl.load(counts + 4 * splat)
    column = tl.arange(0, 16)
    total = tl.zeros([16], tl.float32)
    done = 0
    while done < count:
        rows = done + tl.arange(0, ROWS)
        mask = (rows < count)[:, None] & (column < RECORD)[None, :]
        total += tl.sum(tl.load(partial + (begin + rows)[:, None] * RECORD + column[None, :], mask, 0.0), axis=0)
        done += ROWS
    tl.store(pulls + splat * RECORD + column, total, column < RECORD)
