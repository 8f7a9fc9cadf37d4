"""Records: the nine numbers per splat that compositing reads. Factors and logarithms are chosen so that a pixel needs no division.

    x, y, along, shear, across, log2_opacity, red, green, blue
    alpha = 2^(along · dy² + across · (dx - shear · dy)² + log2_opacity)

with along = -log2(e)/2 / yy and across = -log2(e)/2 · yy / det; yy, shear and det are those of `filters.Footprint`.

Viewers' settings take no further numbers. The opacity of a splat that fades is that over 1 - w_end, so that alpha = opacity · (weight - w_end).
A culled splat, which is listed for its gradient, has `along` of the wrong sign.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from mipmap_plugin.backends.triton_kernels import RECORD as WIDTH
from mipmap_plugin.backends.triton_kernels import views

MIN_ALPHA, W_END, LOG2_W_CUT = views.MIN_ALPHA, views.W_END, views.LOG2_W_CUT

RECORD = tl.constexpr(WIDTH)
HALF_LOG2_E = tl.constexpr(0.5 * math.log2(math.e))
LN_2 = tl.constexpr(math.log(2))


@triton.jit
def falloff(records, at, mask):
    """x, y, along, shear, across, log2_opacity of the splats `at` [B], whether culled or not."""
    row = records + at * RECORD
    x, y = tl.load(row, mask, 0.0), tl.load(row + 1, mask, 0.0)
    along, shear = tl.load(row + 2, mask, 0.0), tl.load(row + 3, mask, 0.0)
    across, log2_opacity = tl.load(row + 4, mask, 0.0), tl.load(row + 5, mask, 0.0)
    return x, y, -tl.abs(along), shear, across, log2_opacity


@triton.jit
def end_of(view, log2_opacity):
    """Where splats end: along · dy² + across · (dx - shear · dy)² is there -`end_of`, which is not negative."""
    least = tl.load(view + W_END) + tl.load(view + MIN_ALPHA) * tl.exp2(-log2_opacity)
    return tl.maximum(-tl.maximum(tl.log2(least), tl.load(view + LOG2_W_CUT)), 0.0)


@triton.jit
def store_six(rows, a, b, c, d, e, f, mask):
    """Store six numbers [B] side by side at the pointers `rows` [B]."""
    tl.store(rows, a, mask)
    tl.store(rows + 1, b, mask)
    tl.store(rows + 2, c, mask)
    tl.store(rows + 3, d, mask)
    tl.store(rows + 4, e, mask)
    tl.store(rows + 5, f, mask)
