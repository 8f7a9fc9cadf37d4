"""A splat's integral over each pixel's square (`splatting.pixel_integral` has the formulas), 16 pixels at a time, and its gradients.

A splat is binned by an ellipse around all that it can touch: that of its Gaussian, widened by half a pixel's diagonal.
"""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

import math

from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.blocks import put
from mipmap_plugin.backends.cpu_kernels.lanes import fma, maximum, minimum, narrow, select, sqrt
from mipmap_plugin.backends.cpu_kernels.powers import exp2, log2, tanh
from mipmap_plugin.effects import MIN_ALPHA
from mipmap_plugin.splatting.pixel_integral import BOUND, CUBIC, LINEAR, MAX_POWER, ROUND

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
    """The direction (cos, sin) of a shape's longer axis, and the standard deviations along it and across, px.

    All here that concerns shapes is in lanes of float64, 16 splats; what concerns pixels, in lanes of float32.
    """
    mean, half, spread = polar(flat)
    round_ = spread <= 0
    per_spread = 1 / select(round_, 1.0, spread)
    cos_2, sin_2 = select(round_, 1.0, half * per_spread), select(round_, 0.0, flat[1] * per_spread)
    larger = sqrt(0.5 + 0.5 * maximum(cos_2, -cos_2))  # of cos and |sin|; the other from their product, which does not cancel
    other = 0.5 * sin_2 / larger
    lying = cos_2 >= 0
    cos, sin = select(lying, larger, maximum(other, -other)), select(lying, other, select(sin_2 < 0, -larger, larger))
    return cos, sin, sqrt(mean + spread), sqrt(flat[3] / (mean + spread))


@inner
def polar(flat):
    """The mean of the variances, half the difference of those along x and y, and half that of those along the axes; 0: round."""
    xx, xy, yy, _ = flat
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    spread = sqrt(half * half + xy * xy)
    return mean, half, select(spread > ROUND * mean, spread, 0.0)


@inner
def pull_axes(flat, d_log_long, d_log_short, d_angle):
    """The gradient of a shape from those of its axes' angle and of the logarithms of their lengths."""
    xy, det = flat[1], flat[3]
    mean, half, spread = polar(flat)
    d_mean = 0.5 * (d_log_long - d_log_short) / (mean + spread)
    oblong = spread > 0
    per_spread = 1 / select(oblong, spread, 1.0)
    turn = 0.5 * d_angle * per_spread * per_spread
    d_half = select(oblong, d_mean * half * per_spread - turn * xy, 0.0)
    d_xy = select(oblong, d_mean * xy * per_spread + turn * half, 0.0)
    return 0.5 * (d_mean + d_half), d_xy, 0.5 * (d_mean - d_half), 0.5 * d_log_short / det


@inner
def brightest(along, opacity):
    """Alpha of a pixel in the middle of a splat with these axes."""
    _, _, long, short = along
    return opacity * 2 * math.pi * long * tanh(0.5 * grown(0.5 / long)) * short * tanh(0.5 * grown(0.5 / short))


@inner
def grown(x):
    return x * (LINEAR + CUBIC * x * x)


@inner
def around(flat, along, opacity, corner):
    """A shape and an opacity whose ellipse alpha >= 1/255 holds all pixels within `corner` px of which the splat reaches that.

    The ellipse of reach r and the disc of radius c add up to no more than the one with (1 + k)·Σ + (1 + 1/k)·(c/r)², for any k.
    """
    xx, xy, yy, det = flat
    bound = maximum(opacity, MARGIN * MIN_ALPHA)
    corner = corner / sqrt(2 * math.log(2) * log2(bound / MIN_ALPHA))
    k = minimum(1.0, corner / along[3])
    a, e = 1 + k, (1 + 1 / k) * corner * corner
    return (a * xx + e, a * xy, a * yy + e, a * a * det + e * a * (xx + yy) + e * e), bound


@inner
def mass(along, opacity):
    """opacity · 2π · both standard deviations, px²."""
    return opacity * 2 * math.pi * along[2] * along[3]


@inner
def fill(along, mass, block):
    """Write what `alpha` needs of 16 splats."""
    cos, sin, long, short = along
    put(block, col.COS, narrow(cos))
    put(block, col.SIN, narrow(sin))
    put(block, col.PER_LONG, narrow(1 / long))
    put(block, col.PER_SHORT, narrow(1 / short))
    put(block, col.MASS, narrow(mass))


@inner
def alpha(splat, dx, dy):
    """Alpha, not clamped, at lanes of pixels dx, dy px from the center."""
    cos, sin = splat[col.COS], splat[col.SIN]
    along = share(fma(dx, cos, sin * dy), splat[col.PER_LONG])
    across = share(fma(dx, 0 - sin, cos * dy), splat[col.PER_SHORT])
    return along[0] * splat[col.MASS] * across[0]


@inner
def slopes(splat, dx, dy):
    """`alpha`, and of its logarithm: the derivatives by u/long and v/short, by the logarithms of long and short, and by the angle."""
    cos, sin, per_long, per_short = splat[col.COS], splat[col.SIN], splat[col.PER_LONG], splat[col.PER_SHORT]
    u, v = fma(dx, cos, sin * dy), fma(dx, 0 - sin, cos * dy)
    along, across = share(u, per_long), share(v, per_short)
    by_u, by_long = slope(along)
    by_v, by_short = slope(across)
    turn = by_u * per_long * v - by_v * per_short * u
    return along[0] * splat[col.MASS] * across[0], by_u, by_v, by_long, by_short, turn


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
