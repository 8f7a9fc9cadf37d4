"""Backward pass of compositing: from the gradients of a tile's pixels to those of its splats' records, front to back as in the forward pass.

The color behind a splat is the image's color minus that in front of it, so only the image has to be stored, and transmittance is
never recovered by division. The sums over a tile's pixels are added to the splats atomically or, for a fixed order of summation,
written to one row per pair, which `gather_kernel` sums in the order of the pairs.
"""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin.backends.triton_kernels import views
from mipmap_plugin.backends.triton_kernels.compositing import USUAL_MAX_ALPHA, alpha_at, cut_offs, drawn, is_culled, largest, pixels, record_at, slots
from mipmap_plugin.backends.triton_kernels.records import LN_2, RECORD
from mipmap_plugin.backends.triton_kernels.vectors import load3

MIN_TRANSMITTANCE, NUMBERS = views.MIN_TRANSMITTANCE, views.NUMBERS


@triton.jit
def nine(a, b, c, d, e, f, g, h, i):
    """Nine numbers side by side in [16], so that one instruction adds them to memory."""
    field = tl.arange(0, 16)
    row = tl.where(field == 0, a, tl.where(field == 1, b, tl.where(field == 2, c, tl.where(field == 3, d, tl.where(field == 4, e, f)))))
    return field, tl.where(field == 6, g, tl.where(field == 7, h, tl.where(field == 8, i, row)))


@triton.jit
def grad_as_viewed(record, raw, alpha, weight, d_weight, rest, limits):
    """For the pixels [P]: the new `rest`, the gradients of ln alpha as it peaks and as it falls off, and the weight that is drawn.

    Of a culled splat it is the gradient of its gate, as if it were drawn first; nothing else of it has one. A splat that fades has
    alpha = opacity · (w - w_end), of which only opacity · w falls off.
    """
    _least, most, _cut, end = limits
    culled, added = is_culled(record), weight * d_weight
    rest = tl.where(culled, rest, rest - added)
    root = tl.rsqrt(1 - alpha)
    d_log = added - alpha * rest * tl.where(culled, 1.0, root * root)
    d_log = tl.where((weight > 0) & (raw <= tl.where(culled, float("inf"), most)), d_log, 0.0)
    falls = d_log + d_log * (end * tl.exp2(record[5])) / tl.where(raw > 0, raw, 1.0)
    return rest, d_log, tl.where(culled, 0.0, falls), tl.where(culled, 0.0, weight)


@triton.jit(do_not_specialize=["most_pixels"])
def composite_back_kernel(
    records, tile_offsets, splat_ids, places, shots, images, transmittances, d_images, d_alphas, d_records, most_pixels,
    TILE: tl.constexpr, BATCH: tl.constexpr, DETERMINISTIC: tl.constexpr, VIEWER: tl.constexpr,
):  # fmt: skip
    """Add the gradients of one tile's pixels to `d_records`, which are in the order of the splats; the `records` are in that of the lists."""
    view = shots + tl.program_id(1) * NUMBERS
    px, py, at, inside = pixels(view, most_pixels, TILE)
    slot, end = slots(tile_offsets)
    limits, stop = cut_offs(view), tl.load(view + MIN_TRANSMITTANCE)
    running = tl.where(inside, 1.0, 0.0)
    d_red, d_green, d_blue = load3(d_images + 3 * at, inside)
    shown = load3(images + 3 * at, inside)
    # What the remaining splats and the background contribute to the loss. The gradient of alpha acts like a color of the background.
    rest = d_red * shown[0] + d_green * shown[1] + d_blue * shown[2] - tl.load(d_alphas + at, inside, 0.0) * tl.load(transmittances + at, inside, 0.0)
    while (slot < end) & (largest(running) >= stop.to(tl.int32, bitcast=True)):
        batch, heaviest = (), tl.zeros_like(running)
        for nth in tl.static_range(BATCH):
            record = record_at(records, slot + nth, end)
            dy, u, raw, alpha = alpha_at(record, px, py, limits, VIEWER)
            behind = running * (1 - drawn(record, alpha, VIEWER))
            weight = tl.where(behind >= stop, running * alpha, 0.0)
            batch += ((record, dy, u, raw, alpha, weight),)
            heaviest, running = tl.maximum(heaviest, weight), behind
        if largest(heaviest) > 0:
            for nth in tl.static_range(BATCH):
                record, dy, u, raw, alpha, weight = batch[nth]
                _x, _y, along, shear, across, _opacity, red, green, blue = record
                d_weight = d_red * red + d_green * green + d_blue * blue
                # The gradient of ln alpha is alpha · d_alpha, and 0 where alpha was cut off or the pixel had stopped.
                if VIEWER:
                    rest, d_log, d_shape, weight = grad_as_viewed(record, raw, alpha, weight, d_weight, rest, limits)
                else:
                    rest -= weight * d_weight
                    root = tl.rsqrt(1 - alpha)  # a division takes several instructions more
                    d_log = weight * d_weight - alpha * rest * (root * root)
                    d_log = tl.where((weight > 0) & (raw <= USUAL_MAX_ALPHA), d_log, 0.0)
                    d_shape = d_log
                d_log_u, d_log_y = d_shape * u, d_shape * dy
                along, across = -2 * LN_2 * along, -2 * LN_2 * across
                d_u = across * tl.sum(d_log_u, axis=0)
                field, sums = nine(
                    d_u, along * tl.sum(d_log_y, axis=0) - shear * d_u, LN_2 * tl.sum(d_log_y * dy, axis=0),
                    across * tl.sum(d_log_u * dy, axis=0), LN_2 * tl.sum(d_log_u * u, axis=0), LN_2 * tl.sum(d_log, axis=0),
                    tl.sum(weight * d_red, axis=0), tl.sum(weight * d_green, axis=0), tl.sum(weight * d_blue, axis=0),
                )  # fmt: skip
                mask = (field < RECORD) & (slot + nth < end)
                if DETERMINISTIC:
                    tl.store(d_records + tl.load(places + slot + nth, slot + nth < end, 0) * RECORD + field, sums, mask)
                else:
                    splat = tl.load(splat_ids + slot + nth, slot + nth < end, 0).to(tl.int64)
                    tl.atomic_add(d_records + splat * RECORD + field, sums, mask, sem="relaxed")
        slot += BATCH


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
