"""Backward pass of compositing: from the gradients of a tile's pixels to those of its splats' records, front to back as in the forward pass.

The color behind a splat is the image's color minus that in front of it, so only the image has to be stored, and transmittance is
never recovered by division. The sums over a tile's pixels are added to the splats atomically or, for a fixed order of summation,
written to one row per pair, which `gather_kernel` sums in the order of the pairs.
"""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin.backends.triton_kernels import views
from mipmap_plugin.backends.triton_kernels.compositing import MAX_ALPHA, alpha_at, largest, pixels, slots, splat_at
from mipmap_plugin.backends.triton_kernels.records import LN_2, RECORD
from mipmap_plugin.backends.triton_kernels.vectors import load3

MIN_ALPHA, MIN_TRANSMITTANCE, NUMBERS = views.MIN_ALPHA, views.MIN_TRANSMITTANCE, views.NUMBERS


@triton.jit
def nine(a, b, c, d, e, f, g, h, i):
    """Nine numbers side by side in [16], so that one instruction adds them to memory."""
    field = tl.arange(0, 16)
    row = tl.where(field == 0, a, tl.where(field == 1, b, tl.where(field == 2, c, tl.where(field == 3, d, tl.where(field == 4, e, f)))))
    return field, tl.where(field == 6, g, tl.where(field == 7, h, tl.where(field == 8, i, row)))


@triton.jit(do_not_specialize=["most_pixels"])
def composite_back_kernel(
    records, splat_ids, tile_offsets, places, shots, images, transmittances, d_images, d_alphas, d_records, most_pixels,
    TILE: tl.constexpr, BATCH: tl.constexpr, DETERMINISTIC: tl.constexpr,
):  # fmt: skip
    """Add the gradients of one tile's pixels to `d_records`."""
    view = shots + tl.program_id(1) * NUMBERS
    px, py, at, inside = pixels(view, most_pixels, TILE)
    slot, end = slots(tile_offsets)
    least, stop = tl.load(view + MIN_ALPHA), tl.load(view + MIN_TRANSMITTANCE)
    running = tl.where(inside, 1.0, 0.0)
    d_red, d_green, d_blue = load3(d_images + 3 * at, inside)
    red, green, blue = load3(images + 3 * at, inside)
    # What the remaining splats and the background contribute to the loss. The gradient of alpha acts like a color of the background.
    rest = d_red * red + d_green * green + d_blue * blue - tl.load(d_alphas + at, inside, 0.0) * tl.load(transmittances + at, inside, 0.0)
    while (slot < end) & (largest(running) >= stop.to(tl.int32, bitcast=True)):
        for _ in tl.static_range(BATCH):
            splat, row = splat_at(records, splat_ids, slot, end)
            dy, u, raw, alpha = alpha_at(row, slot < end, px, py, least)
            behind = running * (1 - alpha)
            weight = tl.where(behind >= stop, running * alpha, 0.0)
            if largest(weight) > 0:
                d_weight = d_red * tl.load(row + 6) + d_green * tl.load(row + 7) + d_blue * tl.load(row + 8)
                rest -= weight * d_weight
                # The gradient of ln alpha is alpha · d_alpha, and 0 where alpha was cut off or the pixel had stopped.
                root = tl.rsqrt(1 - alpha)  # a division takes several instructions more
                d_log = weight * d_weight - alpha * rest * (root * root)
                d_log = tl.where((weight > 0) & (raw <= MAX_ALPHA), d_log, 0.0)
                d_log_u, d_log_y = d_log * u, d_log * dy
                along, shear, across = tl.load(row + 2) * LN_2, tl.load(row + 3), tl.load(row + 4) * LN_2
                d_u = -2 * across * tl.sum(d_log_u, axis=0)
                field, sums = nine(
                    d_u, -2 * along * tl.sum(d_log_y, axis=0) - shear * d_u, LN_2 * tl.sum(d_log_y * dy, axis=0),
                    -2 * across * tl.sum(d_log_u * dy, axis=0), LN_2 * tl.sum(d_log_u * u, axis=0), LN_2 * tl.sum(d_log, axis=0),
                    tl.sum(weight * d_red, axis=0), tl.sum(weight * d_green, axis=0), tl.sum(weight * d_blue, axis=0),
                )  # fmt: skip
                if DETERMINISTIC:
                    tl.store(d_records + tl.load(places + slot) * RECORD + field, sums, field < RECORD)
                else:
                    tl.atomic_add(d_records + splat * RECORD + field, sums, field < RECORD, sem="relaxed")
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
