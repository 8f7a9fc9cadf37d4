"""Pictures of few bits: the image again, back to front, rounded after each splat. The gradient remains that of the unrounded image."""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin.backends.triton_kernels import views
from mipmap_plugin.backends.triton_kernels.compositing import alpha_at, cut_offs, drawn, pixels, record_at, slots

RED, GREEN, BLUE, PICTURE_STEP, NUMBERS = views.RED, views.GREEN, views.BLUE, views.PICTURE_STEP, views.NUMBERS

# 1.5 · 2^23: adding it to a float32 and subtracting it again rounds to the nearest integer. Larger numbers than the second are not rounded.
ROUNDER, LARGEST_ROUNDED = tl.constexpr(12582912.0), tl.constexpr(4194304.0)


@triton.jit
def round_to(value, step):
    """The nearest multiples of `step`; `value` itself for a step of 0."""
    steps = value / tl.where(step > 0, step, 1.0)
    return tl.where(step > 0, tl.where(tl.abs(steps) < LARGEST_ROUNDED, (steps + ROUNDER - ROUNDER) * step, value), value)


@triton.jit
def blended(alpha, color, behind, step):
    """One channel of a splat over what is `behind` it, rounded and within 0..1."""
    after = round_to(tl.minimum(alpha * color, 1.0) + (1 - alpha) * behind, step)
    return tl.where(alpha > 0, tl.minimum(tl.maximum(after, 0.0), 1.0), behind)


@triton.jit(do_not_specialize=["most_pixels"])
def round_kernel(records, tile_offsets, shots, images, most_pixels, TILE: tl.constexpr, BATCH: tl.constexpr):
    """Draw one tile of `images` again, where its view rounds pictures."""
    view = shots + tl.program_id(1) * NUMBERS
    step, limits = tl.load(view + PICTURE_STEP), cut_offs(view)
    if step > 0:
        px, py, at, inside = pixels(view, most_pixels, TILE)
        begin, end = slots(tile_offsets)
        nothing = tl.zeros_like(px)
        red, green, blue = nothing + tl.load(view + RED), nothing + tl.load(view + GREEN), nothing + tl.load(view + BLUE)
        slot = end - 1
        while slot >= begin:
            for _ in tl.static_range(BATCH):
                record = record_at(records, tl.where(slot >= begin, slot, end), end)
                _dy, _u, _raw, alpha = alpha_at(record, px, py, limits, VIEWER=True)
                alpha = drawn(record, alpha, VIEWER=True)
                red, green = blended(alpha, record[6], red, step), blended(alpha, record[7], green, step)
                blue = blended(alpha, record[8], blue, step)
                slot -= 1
        tl.store(images + 3 * at, red, inside)
        tl.store(images + 3 * at + 1, green, inside)
        tl.store(images + 3 * at + 2, blue, inside)
