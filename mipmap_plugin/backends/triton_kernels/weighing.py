"""The sum of each splat's blend weights over an image."""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin.backends.triton_kernels import views
from mipmap_plugin.backends.triton_kernels.compositing import blended, cut_offs, largest, pixels, slots

MIN_TRANSMITTANCE, NUMBERS = views.MIN_TRANSMITTANCE, views.NUMBERS


@triton.jit(do_not_specialize=["most_pixels"])
def weigh_kernel(
    records, tile_offsets, splat_ids, shots, sums, most_pixels,
    TILE: tl.constexpr, BATCH: tl.constexpr, DETERMINISTIC: tl.constexpr, VIEWER: tl.constexpr,
):  # fmt: skip
    """Add the blend weights in one tile to `sums`, or with deterministic sums store them there by pair, in the order of `composite_kernel`."""
    view = shots + tl.program_id(1) * NUMBERS
    px, py, _at, inside = pixels(view, most_pixels, TILE)
    slot, end = slots(tile_offsets)
    limits, stop = cut_offs(view), tl.load(view + MIN_TRANSMITTANCE)
    running = tl.where(inside, 1.0, 0.0)
    while (slot < end) & (largest(running) >= stop.to(tl.int32, bitcast=True)):
        for _ in tl.static_range(BATCH):
            _record, weight, behind = blended(records, slot, end, px, py, running, stop, limits, VIEWER)
            total = tl.sum(weight, axis=0)
            if DETERMINISTIC:
                tl.store(sums + slot, total, slot < end)
            else:
                splat = tl.load(splat_ids + slot, slot < end, 0)
                tl.atomic_add(sums + splat, total, total > 0, sem="relaxed")
            running = behind
            slot += 1
