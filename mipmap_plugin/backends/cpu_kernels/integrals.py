"""A splat's integral over each pixel's square (`backends.pixel_integral` has the formulas), 16 pixels at a time, and its gradients.

A splat is binned by an ellipse around all that it can touch: that of its Gaussian, widened by half a pixel's diagonal.
"""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

import math

from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.lanes import exp2, fma, maximum, minimum, select
from mipmap_plugin.backends.pixel_integral import BOUND, CUBIC, LINEAR, MAX_POWER, ROUND
from mipmap_plugin.effects import MIN_ALPHA

LOG2E = 1 / math.log(2)

# A Gaussian of so many times the opacity is nowhere darker than the integral.
BRIGHTER = BOUND * BOUND

# px: from a pixel's center to its corner.
CORNER = math.sqrt(0.5)

# 1 - exp(-w) is summed as a series below this, where the difference would cancel.
SMALL = 0.25

# How far above 1/255 the bound of the dimmest splat is taken, so that its ellipse has a size.
MARGIN = 1.01


@inner
def axes(flat):
    """The direction (cos, sin) of a shape's longer axis, and the standard deviations along it and across, px."""
    mean, half, spread = polar(flat)
    angle = 0.5 * math.atan2(flat[1], half) if spread > 0 else 0.0
    return math.cos(angle), math.sin(angle), math.sqrt(mean + spread), math.sqrt(flat[3] / (mean + spread))


@inner
def polar(flat):
    """The mean of the variances, half the difference of those along x and y, and half that of those along the axes; 0: round."""
    xx, xy, yy, _ = flat
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    spread = math.sqrt(half * half + xy * xy)
    return mean, half, spread if spread > ROUND * mean else 0.0


@inner
def pull_axes(flat, d_log_long, d_log_short, d_angle):
    """The gradient of a shape from those of its axes' angle and of the logarithms of their lengths."""
    xy, det = flat[1], flat[3]
    mean, half, spread = polar(flat)
    d_mean = 0.5 * (d_log_long - d_log_short) / (mean + spread)
    d_half = d_xy = 0.0
    if spread > 0:
        turn = 0.5 * d_angle / (spread * spread)
        d_half = d_mean * half / spread - turn * xy
        d_xy = d_mean * xy / spread + turn * half
    return 0.5 * (d_mean + d_half), d_xy, 0.5 * (d_mean - d_half), 0.5 * d_log_short / det


@inner
def brightest(along, opacity):
    """Alpha of a pixel in the middle of a splat with these axes."""
    _, _, long, short = along
    return opacity * 2 * math.pi * long * math.tanh(0.5 * grown(0.5 / long)) * short * math.tanh(0.5 * grown(0.5 / short))


@inner
def grown(x):
    return x * (LINEAR + CUBIC * x * x)


@inner
def around(flat, along, opacity, corner):
    """A shape and an opacity whose ellipse alpha >= 1/255 holds all pixels within `corner` px of which the splat reaches that.

    The ellipse of reach r and the disc of radius c add up to no more than the one with (1 + k)·Σ + (1 + 1/k)·(c/r)², for any k.
    """
    xx, xy, yy, det = flat
    bound = max(opacity, MARGIN * MIN_ALPHA)
    reach = math.sqrt(2 * math.log(bound / MIN_ALPHA))
    corner /= reach
    k = min(1.0, corner / along[3])
    a, e = 1 + k, (1 + 1 / k) * corner * corner
    return (a * xx + e, a * xy, a * yy + e, a * a * det + e * a * (xx + yy) + e * e), bound


@inner
def mass(along, opacity):
    """opacity · 2π · both standard deviations, px²."""
    return opacity * 2 * math.pi * along[2] * along[3]


@inner
def fill(along, mass, table, i):
    """Write what `alpha` needs of a splat."""
    cos, sin, long, short = along
    table[i, col.COS], table[i, col.SIN], table[i, col.PER_LONG], table[i, col.PER_SHORT] = cos, sin, 1 / long, 1 / short
    table[i, col.MASS] = mass


@inner
def alpha(table, i, dx, dy):
    """Alpha, not clamped, at lanes of pixels dx, dy px from the center."""
    cos, sin = table[i, col.COS], table[i, col.SIN]
    along = share(fma(dx, cos, sin * dy), table[i, col.PER_LONG])
    across = share(fma(dx, 0 - sin, cos * dy), table[i, col.PER_SHORT])
    return along[0] * table[i, col.MASS] * across[0]


@inner
def slopes(table, i, dx, dy):
    """`alpha`, and of its logarithm: the derivatives by u/long and v/short, by the logarithms of long and short, and by the angle."""
    cos, sin, per_long, per_short = table[i, col.COS], table[i, col.SIN], table[i, col.PER_LONG], table[i, col.PER_SHORT]
    u, v = fma(dx, cos, sin * dy), fma(dx, 0 - sin, cos * dy)
    along, across = share(u, per_long), share(v, per_short)
    by_u, by_long = slope(along)
    by_v, by_short = slope(across)
    turn = by_u * per_long * v - by_v * per_short * u
    return along[0] * table[i, col.MASS] * across[0], by_u, by_v, by_long, by_short, turn


@inner
def share(u, per_sigma):
    """The share of a splat's mass within half a pixel of u along one axis, and what its derivatives are made of."""
    t, h = u * per_sigma, 0.5 * per_sigma
    before, after = t - h, t + h
    p = power(before * fma(before * before, CUBIC, LINEAR))
    q = power(0 - after * fma(after * after, CUBIC, LINEAR))
    w = fma(t * t, 3 * CUBIC, LINEAR + CUBIC * h * h) * (2 * h)
    series = fma(w, -1 / 720, 1 / 120)
    series = fma(series, w, -1 / 24)
    series = fma(series, w, 1 / 6)
    series = fma(series, w, -0.5)
    series = fma(series, w, 1.0) * w
    lost = select(w < SMALL, series, 1 - p * q)  # 1 - exp(-w)
    return lost / ((1 + p) * (1 + q)), p, q, lost, t, h


@inner
def power(x):
    """exp(x) where it matters: cut off where float32 would not hold it."""
    return exp2(minimum(maximum(x * LOG2E, -125.0), MAX_POWER * LOG2E))


@inner
def slope(shared):
    """The derivatives of log(sigma · share) by t = u/sigma and by log sigma."""
    _, p, q, lost, t, h = shared
    before, after = t - h, t + h
    left = p / (1 + p) * fma(before * before, 3 * CUBIC, LINEAR)
    right = q / (1 + q) * fma(after * after, 3 * CUBIC, LINEAR)
    odds = (1 - lost) / lost * 2
    by_h = fma(t * t, 3 * CUBIC, LINEAR + 3 * CUBIC * h * h)  # of w/2, as the next
    by_t = t * (6 * CUBIC * h)
    return odds * by_t - left + right, 1 - odds * fma(by_t, t, by_h * h) + before * left - after * right
