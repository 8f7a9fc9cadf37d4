"""A step of Adam over the raw parameters of 3DGS, all five in one launch (`backends.base.AdamStep`)."""

from __future__ import annotations

import triton
import triton.language as tl

# Indices into the numbers of a step: rates, and what all parameters share.
MEANS, QUATS, SCALES, OPACITIES, SH0, SHN = (tl.constexpr(index) for index in range(6))
NEW_FIRST, NEW_SECOND, NEWEST, CORRECTION, EPS = (tl.constexpr(index) for index in range(6, 11))


@triton.jit
def move(raw, first, second, grads, at, count, step, rate):
    """Move the numbers `at` [B] of a parameter that has `count`, at the rates `rate` [B]."""
    inside = at < count
    gradient, mean, square = tl.load(grads + at, inside, 0.0), tl.load(first + at, inside, 0.0), tl.load(second + at, inside, 0.0)
    mean += (gradient - mean) * tl.load(step + NEW_FIRST)
    square += (gradient * gradient - square) * tl.load(step + NEW_SECOND)
    tl.store(first + at, mean, inside)
    tl.store(second + at, square, inside)
    ahead = mean + (gradient - mean) * tl.load(step + NEWEST)
    moved = rate * ahead / (tl.sqrt(square) * tl.load(step + CORRECTION) + tl.load(step + EPS))
    tl.store(raw + at, tl.load(raw + at, inside, 0.0) - moved, inside)


@triton.jit(do_not_specialize=["count"])
def adam_kernel(
    means, means_1, means_2, d_means, quats, quats_1, quats_2, d_quats, scales, scales_1, scales_2, d_scales,
    opacities, opacities_1, opacities_2, d_opacities, sh, sh_1, sh_2, d_sh, step, count, BANDS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Move `count` splats: the program's second number is that of the parameter, each of which is followed by its moments and gradient."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    which, count = tl.program_id(1), count.to(tl.int64)  # 45 million splats have more than 2^31 coefficients
    if which == 0:
        rate = tl.where(at % (3 * BANDS) < 3, tl.load(step + SH0), tl.load(step + SHN))
        move(sh, sh_1, sh_2, d_sh, at, count * (3 * BANDS), step, rate)
    elif which == 1:
        move(quats, quats_1, quats_2, d_quats, at, count * 4, step, tl.load(step + QUATS))
    elif which == 2:
        move(means, means_1, means_2, d_means, at, count * 3, step, tl.load(step + MEANS))
    elif which == 3:
        move(scales, scales_1, scales_2, d_scales, at, count * 3, step, tl.load(step + SCALES))
    else:
        move(opacities, opacities_1, opacities_2, d_opacities, at, count, step, tl.load(step + OPACITIES))
