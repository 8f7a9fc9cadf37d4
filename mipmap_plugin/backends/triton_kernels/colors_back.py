"""Backward pass of colors: from their gradients to those of the coefficients and of the direction in which a splat is seen.

Apart from the rest of projection's, because Triton's compiler takes time with the square of the loads and stores of a kernel.
"""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin.backends.triton_kernels import views
from mipmap_plugin.backends.triton_kernels.harmonics import color, color_back
from mipmap_plugin.backends.triton_kernels.projection import by_channel, direction
from mipmap_plugin.backends.triton_kernels.records import RECORD
from mipmap_plugin.backends.triton_kernels.vectors import add, load3, store3
from mipmap_plugin.backends.triton_kernels.views import from_eye

NUMBERS, SH_DEGREE, MAX_COLOR = views.NUMBERS, views.SH_DEGREE, views.MAX_COLOR


@triton.jit(do_not_specialize=["count", "views", "further"])
def color_back_kernel(
    means, sh, shots, depths, d_records, d_sh, count, views, further,
    DEGREE: tl.constexpr, BANDS: tl.constexpr, VIEWER: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the gradients of the coefficients, summed over the views, or add them to what is there if `further` is 1.

    In `d_records`, those of the direction from the eye take the place of the colors'.
    """
    at = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    inside = at < count
    rows, channel, written = by_channel(at, inside)
    coefficients, d_coefficients = sh + rows * (3 * BANDS) + channel, d_sh + rows * (3 * BANDS) + channel
    for band in tl.static_range((DEGREE + 1) * (DEGREE + 1), BANDS):
        add(d_coefficients + 3 * band, tl.zeros([BLOCK, 4], tl.float32), written, further > 0)
    number = tl.program_id(0) * 0
    while number < views:
        view, first = shots + number * NUMBERS, number.to(tl.int64) * count
        seen = tl.load(depths + first + at, inside, float("inf")) < float("inf")
        shown = seen[:, None] & written
        dx, dy, dz, _ = direction(from_eye(view, *load3(means + 3 * rows, shown)))
        degree = tl.load(view + SH_DEGREE)
        value = color(coefficients, dx, dy, dz, degree, shown, DEGREE)
        d_color = tl.load(d_records + (first + rows) * RECORD + 6 + channel, shown, 0.0)
        d_color = tl.where(value < -0.5, 0.0, d_color)
        if VIEWER:
            d_color = tl.where(value + 0.5 > tl.load(view + MAX_COLOR), 0.0, d_color)
        px, py, pz = color_back(coefficients, d_coefficients, dx, dy, dz, degree, d_color, shown, written, number + further > 0, DEGREE)
        tl.debug_barrier()  # all channels are read before the directions are stored
        store3(d_records + (first + at) * RECORD + 6, tl.sum(px, axis=1), tl.sum(py, axis=1), tl.sum(pz, axis=1), seen)
        number += 1
