"""A splat's integral over each pixel's square, 16 pixels at a time, and its gradients (formulas: `splatting.pixel_integral`).

Splats are binned by a bounding ellipse: that of the Gaussian, extended by half a pixel's diagonal.
"""

# numba redefines calls and operators.
# mypy: ignore-errors

import math

from mipmap_plugin.backends.cpu_kernels import inner, layout
from mipmap_plugin.backends.cpu_kernels.blocks import put
from mipmap_plugin.backends.cpu_kernels.lanes import fma, maximum, minimum, narrow, select, sqrt
from mipmap_plugin.backends.cpu_kernels.powers import LARGEST_POWER, LOG2E, exp2, log2, tanh
from mipmap_plugin.render_settings import MIN_ALPHA
from mipmap_plugin.splatting.pixel_integral import BOUND, CUBIC, LINEAR, MAX_POWER, ROUND

# A Gaussian with this factor times the opacity is an upper bound of the integral.
BOUND_SQUARED = BOUND * BOUND

# px, from a pixel's center to its corner.
CORNER = math.sqrt(0.5)

# Below this w, 1 - exp(-w) is evaluated as a series, because the difference cancels.
SERIES_BELOW = 0.25

# The bound of alpha is at least this factor times 1/255, so that the bounding ellipse of the faintest splat is not empty.
MARGIN = 1.01


@inner
def axes(shape):
    """The direction (cos, sin) of a shape's longer axis, and the standard deviations along it and across, px.

    In this module, shapes are lanes of float64, one for each splat; pixels are lanes of float32.
    """
    mean, half, spread = polar(shape)
    is_round = spread <= 0
    per_spread = 1 / select(is_round, 1.0, spread)
    cos_2, sin_2 = select(is_round, 1.0, half * per_spread), select(is_round, 0.0, shape[1] * per_spread)
    larger = sqrt(0.5 + 0.5 * maximum(cos_2, -cos_2))  # of cos and |sin|; the smaller follows from their product without cancellation
    smaller = 0.5 * sin_2 / larger
    horizontal = cos_2 >= 0
    cos, sin = select(horizontal, larger, maximum(smaller, -smaller)), select(horizontal, smaller, select(sin_2 < 0, -larger, larger))
    return cos, sin, sqrt(mean + spread), sqrt(shape[3] / (mean + spread))


@inner
def polar(shape):
    """The mean of the variances, half the difference of those along x and y, and half that of those along the axes; 0 for a round splat."""
    xx, xy, yy, _ = shape
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    spread = sqrt(half * half + xy * xy)
    return mean, half, select(spread > ROUND * mean, spread, 0.0)


@inner
def grad_axes(shape, d_log_long, d_log_short, d_angle):
    """The gradient of a shape from those of its axes' angle and of the logarithms of their lengths."""
    xy, det = shape[1], shape[3]
    mean, half, spread = polar(shape)
    d_mean = 0.5 * (d_log_long - d_log_short) / (mean + spread)
    elongated = spread > 0
    per_spread = 1 / select(elongated, spread, 1.0)
    angle_factor = 0.5 * d_angle * per_spread * per_spread
    d_half = select(elongated, d_mean * half * per_spread - angle_factor * xy, 0.0)
    d_xy = select(elongated, d_mean * xy * per_spread + angle_factor * half, 0.0)
    return 0.5 * (d_mean + d_half), d_xy, 0.5 * (d_mean - d_half), 0.5 * d_log_short / det


@inner
def peak_alpha(splat_axes, opacity):
    """Alpha of a pixel at the center of a splat with these axes."""
    _, _, long, short = splat_axes
    return opacity * 2 * math.pi * long * tanh(0.5 * logit(0.5 / long)) * short * tanh(0.5 * logit(0.5 / short))


@inner
def logit(x):
    """The argument of the logistic function that approximates the normal distribution function at x."""
    return x * (LINEAR + CUBIC * x * x)


@inner
def bounding_ellipse(shape, splat_axes, opacity, corner):
    """A shape and an opacity whose ellipse alpha >= 1/255 contains all pixels where the splat's alpha reaches 1/255.

    `corner`: px by which the ellipse is extended. The sum of the ellipse of Σ with reach r and a disc of radius c lies within the
    ellipse of (1 + k)·Σ + (1 + 1/k)·(c/r)², for any k.
    """
    xx, xy, yy, det = shape
    bound = maximum(opacity, MARGIN * MIN_ALPHA)
    corner = corner / sqrt(2 * math.log(2) * log2(bound / MIN_ALPHA))
    k = minimum(1.0, corner / splat_axes[3])
    a, e = 1 + k, (1 + 1 / k) * corner * corner
    return (a * xx + e, a * xy, a * yy + e, a * a * det + e * a * (xx + yy) + e * e), bound


@inner
def mass(splat_axes, opacity):
    """opacity · 2π · both standard deviations, px²."""
    return opacity * 2 * math.pi * splat_axes[2] * splat_axes[3]


@inner
def put_integral(splat_axes, mass, block):
    """Write the splats' fields that `alpha` needs."""
    cos, sin, long, short = splat_axes
    put(block, layout.COS, narrow(cos))
    put(block, layout.SIN, narrow(sin))
    put(block, layout.PER_LONG, narrow(1 / long))
    put(block, layout.PER_SHORT, narrow(1 / short))
    put(block, layout.MASS, narrow(mass))


@inner
def alpha(splat, dx, dy):
    """Alpha, not clamped, at lanes of pixels dx, dy px from the center."""
    cos, sin = splat[layout.COS], splat[layout.SIN]
    along = pixel_fraction(fma(dx, cos, sin * dy), splat[layout.PER_LONG])
    across = pixel_fraction(fma(dx, 0 - sin, cos * dy), splat[layout.PER_SHORT])
    return along[0] * splat[layout.MASS] * across[0]


@inner
def alpha_slopes(splat, dx, dy):
    """`alpha`, and the derivatives of its logarithm by u/long, v/short, log long, log short and the angle."""
    cos, sin, per_long, per_short = splat[layout.COS], splat[layout.SIN], splat[layout.PER_LONG], splat[layout.PER_SHORT]
    u, v = fma(dx, cos, sin * dy), fma(dx, 0 - sin, cos * dy)
    along, across = pixel_fraction(u, per_long), pixel_fraction(v, per_short)
    by_u, by_log_long = fraction_slopes(along)
    by_v, by_log_short = fraction_slopes(across)
    by_angle = by_u * per_long * v - by_v * per_short * u
    return along[0] * splat[layout.MASS] * across[0], by_u, by_v, by_log_long, by_log_short, by_angle


@inner
def pixel_fraction(u, per_sigma):
    """The fraction of a splat's mass within half a pixel of u along one axis, and the terms that its derivatives share."""
    t, h = u * per_sigma, 0.5 * per_sigma
    before, after = t - h, t + h
    p = clamped_exp(before * fma(before * before, CUBIC, LINEAR))
    q = clamped_exp(0 - after * fma(after * after, CUBIC, LINEAR))
    w = fma(t * t, 3 * CUBIC, LINEAR + CUBIC * h * h) * (2 * h)
    series = fma(w, -1 / 720, 1 / 120)
    series = fma(series, w, -1 / 24)
    series = fma(series, w, 1 / 6)
    series = fma(series, w, -0.5)
    series = fma(series, w, 1.0) * w
    one_minus_pq = select(w < SERIES_BELOW, series, 1 - p * q)  # 1 - exp(-w)
    return one_minus_pq / ((1 + p) * (1 + q)), p, q, one_minus_pq, t, h


@inner
def clamped_exp(x):
    """exp(x), with x clamped to float32's range."""
    return exp2(minimum(maximum(x * LOG2E, 0 - LARGEST_POWER), MAX_POWER * LOG2E))


@inner
def fraction_slopes(fraction):
    """The derivatives of log(sigma · fraction) by t = u/sigma and by log sigma."""
    _, p, q, one_minus_pq, t, h = fraction
    before, after = t - h, t + h
    left = p / (1 + p) * fma(before * before, 3 * CUBIC, LINEAR)
    right = q / (1 + q) * fma(after * after, 3 * CUBIC, LINEAR)
    odds = (1 - one_minus_pq) / one_minus_pq * 2
    by_h = fma(t * t, 3 * CUBIC, LINEAR + 3 * CUBIC * h * h)  # the derivatives of w/2 by h and, next, by t
    by_t = t * (6 * CUBIC * h)
    return odds * by_t - left + right, 1 - odds * fma(by_t, t, by_h * h) + before * left - after * right
