"""Backward pass of compositing: from the gradients of a tile's pixels to those of its splats' records, front to back as in the forward pass.

The color behind a splat is the image's color minus that in front of it, so only the image has to be stored, and transmittance is
never recovered by division. The sums over a tile's pixels are added to the splats atomically or, for a fixed order of summation,
written to one row per pair, which `gather_kernel` sums in the order of the pairs.
"""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin.backends.triton_kernels import views
from mipmap_plugin.backends.triton_kernels.compositing import MAX_ALPHA, alpha_at, pixels, splat_at
from mipmap_plugin.backends.triton_kernels.records import LN_2, RECORD
from mipmap_plugin.backends.triton_kernels.vectors import load3

MIN_ALPHA, MIN_TRANSMITTANCE = views.MIN_ALPHA, views.MIN_TRANSMITTANCE


@triton.jit
def accumulate(at, value, DETERMINISTIC: tl.constexpr):
    """Store a sum over a tile's pixels at `at`, or add it to those of other tiles."""
    if DETERMINISTIC:
        tl.store(at, value)
    else:
        tl.atomic_add(at, value, sem="relaxed")


@triton.jit
def composite_back_kernel(
    records, splat_ids, tile_offsets, places, view, image, transmittances, d_image, d_alpha, d_records, tiles_x, width, height,
    TILE: tl.constexpr, BATCH: tl.constexpr, DETERMINISTIC: tl.constexpr,
):  # fmt: skip
    """Add the gradients of one tile's pixels to `d_records`."""
    px, py, at, inside = pixels(tiles_x, width, height, TILE)
    slot, end = tl.load(tile_offsets + tl.program_id(0)), tl.load(tile_offsets + tl.program_id(0) + 1)
    least, stop = tl.load(view + MIN_ALPHA), tl.load(view + MIN_TRANSMITTANCE)
    running = tl.where(inside, 1.0, 0.0)
    d_red, d_green, d_blue = load3(d_image + 3 * at, inside)
    red, green, blue = load3(image + 3 * at, inside)
    # What the remaining splats and the background contribute to the loss. The gradient of alpha acts like a color of the background.
    rest = d_red * red + d_green * green + d_blue * blue - tl.load(d_alpha + at, inside, 0.0) * tl.load(transmittances + at, inside, 0.0)
    while (slot < end) & (tl.max(running, axis=0) >= stop):
        for _ in tl.static_range(BATCH):
            splat, row = splat_at(records, splat_ids, slot, end)
            dy, u, raw, alpha = alpha_at(row, slot < end, px, py, least)
            behind = running * (1 - alpha)
            weight = tl.where(behind >= stop, running * alpha, 0.0)
            if tl.max(weight, axis=0) > 0:
                d_weight = d_red * tl.load(row + 6) + d_green * tl.load(row + 7) + d_blue * tl.load(row + 8)
                rest -= weight * d_weight
                # The gradient of log2 alpha is alpha · d_alpha · ln 2, and 0 where alpha was cut off or the pixel had stopped.
                d_log2 = (weight * d_weight - alpha / (1 - alpha) * rest) * LN_2
                d_log2 = tl.where((weight > 0) & (raw <= MAX_ALPHA), d_log2, 0.0)
                d_u = -2 * tl.load(row + 4) * tl.sum(d_log2 * u, axis=0)
                d_y = -2 * tl.load(row + 2) * tl.sum(d_log2 * dy, axis=0) - tl.load(row + 3) * d_u
                out = d_records + (tl.load(places + slot) if DETERMINISTIC else splat) * RECORD
                accumulate(out, d_u, DETERMINISTIC)
                accumulate(out + 1, d_y, DETERMINISTIC)
                accumulate(out + 2, tl.sum(d_log2 * dy * dy, axis=0), DETERMINISTIC)
                accumulate(out + 3, -2 * tl.load(row + 4) * tl.sum(d_log2 * u * dy, axis=0), DETERMINISTIC)
                accumulate(out + 4, tl.sum(d_log2 * u * u, axis=0), DETERMINISTIC)
                accumulate(out + 5, tl.sum(d_log2, axis=0), DETERMINISTIC)
                accumulate(out + 6, tl.sum(weight * d_red, axis=0), DETERMINISTIC)
                accumulate(out + 7, tl.sum(weight * d_green, axis=0), DETERMINISTIC)
                accumulate(out + 8, tl.sum(weight * d_blue, axis=0), DETERMINISTIC)
            running = behind
            slot += 1


@triton.jit
def gather_kernel(partial, starts, counts, d_records, ROWS: tl.constexpr):
    """Sum the rows of one splat, `ROWS` at a time in their order. One splat per program."""
    splat = tl.program_id(0).to(tl.int64)
    begin, count = tl.load(starts + splat), tl.load(counts + 4 * splat)
    field = tl.arange(0, 16)
    total = tl.zeros([16], tl.float32)
    done = 0
    while done < count:
        rows = done + tl.arange(0, ROWS)
        mask = (rows < count)[:, None] & (field < RECORD)[None, :]
        total += tl.sum(tl.load(partial + (begin + rows)[:, None] * RECORD + field[None, :], mask, 0.0), axis=0)
        done += ROWS
    tl.store(d_records + splat * RECORD + field, total, field < RECORD)
