"""Culling, stretching and limiting of splats on the image as viewers do it, and the gradients (formulas: `splatting.culls`).

Shapes are (xx, xy, yy, det) after dilation. What a view does not ask for is off by its number there; one splat per lane.
"""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin.backends.triton_kernels import views
from mipmap_plugin.backends.triton_kernels.vectors import LARGEST
from mipmap_plugin.splatting import culls

MIN_VARIANCE, MIN_CONTRIBUTION, LEAST_SPREAD, MAX_VARIANCE = views.MIN_VARIANCE, views.MIN_CONTRIBUTION, views.LEAST_SPREAD, views.MAX_VARIANCE
LEVEL_BELOW = views.LEVEL_BELOW
BOXED, ROOTED = views.BOXED, views.ROOTED

STEEPNESS, ASIDE = tl.constexpr(culls.STEEPNESS), tl.constexpr(culls.ASIDE)

# Outside these ratios of measure and threshold the slope of the gate is 0 to within 1e-10.
MIN_RATIO, MAX_RATIO = tl.constexpr(1e-3), tl.constexpr(1e3)


@triton.jit
def spread_of(xx, xy, yy):
    """Half the difference of the variances along a splat's two axes."""
    half = 0.5 * (xx - yy)
    return tl.sqrt(half * half + xy * xy)


@triton.jit
def over(measure, threshold):
    """The ratio of a measure to a threshold; the largest number for one that is not set."""
    return tl.where(threshold > 0, measure / tl.where(threshold > 0, threshold, 1.0), LARGEST)


@triton.jit
def ratios(view, xx, xy, yy, det, opacity):
    """Measure over threshold for size, contribution and elongation."""
    longer = tl.where(tl.load(view + BOXED) > 0, tl.maximum(xx, yy), 0.5 * (xx + yy) + spread_of(xx, xy, yy))
    weight = tl.where(tl.load(view + ROOTED) > 0, tl.sqrt(opacity), opacity) * tl.sqrt(det)
    size, contribution = over(longer, tl.load(view + MIN_VARIANCE)), over(weight, tl.load(view + MIN_CONTRIBUTION))
    return size, contribution, over(0.5 * (xx + yy), tl.load(view + LEAST_SPREAD))


@triton.jit
def is_drawn(view, xx, xy, yy, det, opacity):
    """Which splats are not culled. opacity: before any compensation."""
    size, contribution, elongation = ratios(view, xx, xy, yy, det, opacity)
    return tl.minimum(tl.minimum(size, contribution), elongation) >= 1


@triton.jit
def gate_back(view, xx, xy, yy, det, opacity, d_gate):
    """Gradients of a shape and of its opacity from that of its gate, through the rule with the least ratio."""
    size, contribution, elongation = ratios(view, xx, xy, yy, det, opacity)
    least = tl.minimum(tl.minimum(size, contribution), elongation)
    ratio = tl.minimum(tl.maximum(least, MIN_RATIO), MAX_RATIO)
    power = ratio * ratio * ratio * ratio
    d_log = tl.where(least < LARGEST, d_gate * STEEPNESS * power / ((1 + power) * (1 + power)), 0.0)  # by the logarithm of the least ratio
    d_size = tl.where(size <= least, d_log, 0.0)
    d_contribution = tl.where((size > least) & (contribution <= least), d_log, 0.0)
    d_mean = tl.where((size > least) & (contribution > least), d_log, 0.0) / (xx + yy)
    spread = spread_of(xx, xy, yy)
    d_longer = d_size / (0.5 * (xx + yy) + spread)
    d_spread = tl.where(spread > 0, d_longer / tl.where(spread > 0, spread, 1.0), 0.0)
    d_half = d_spread * 0.5 * (xx - yy)
    boxed = tl.load(view + BOXED) > 0
    d_xx = d_mean + tl.where(boxed, tl.where(xx >= yy, d_size / xx, 0.0), 0.5 * (d_longer + d_half))
    d_yy = d_mean + tl.where(boxed, tl.where(xx >= yy, 0.0, d_size / yy), 0.5 * (d_longer - d_half))
    d_opacity = d_contribution * tl.where(tl.load(view + ROOTED) > 0, 0.5, 1.0) / tl.where(opacity > 0, opacity, 1.0)
    return d_xx, tl.where(boxed, 0.0, d_spread * xy), d_yy, 0.5 * d_contribution / det, tl.where(opacity > 0, d_opacity, 0.0)


@triton.jit
def turned(view, xx, xy, yy, drawn):
    """Which drawn splats have a spread below the least; the vector (aside, up), the cosine and sine of twice its angle, and 1 / its square."""
    least, spread = tl.load(view + LEAST_SPREAD), spread_of(xx, xy, yy)
    changed = drawn & (spread < least)
    aside, up = tl.where(tl.abs(xy) < tl.load(view + LEVEL_BELOW), ASIDE * least, xy), least - 0.5 * (xx - yy)
    per_squared = 1 / tl.where(changed, aside * aside + up * up, 1.0)
    return changed, aside, up, (aside * aside - up * up) * per_squared, 2 * aside * up * per_squared, per_squared


@triton.jit
def stretched(view, xx, xy, yy, det, drawn):
    """The shapes, with drawn splats stretched whose spread is below the least."""
    least, mean = tl.load(view + LEAST_SPREAD), 0.5 * (xx + yy)
    changed, _aside, _up, cos, sin, _per_squared = turned(view, xx, xy, yy, drawn)
    cos, sin = least * cos, least * sin
    new = (mean - least) * (mean + least)
    return tl.where(changed, mean + cos, xx), tl.where(changed, sin, xy), tl.where(changed, mean - cos, yy), tl.where(changed, new, det)


@triton.jit
def stretched_back(view, xx, xy, yy, drawn, d_xx, d_xy, d_yy, d_det):
    """The gradient of a shape before `stretched`, through its mean and the angle of (aside, up)."""
    least = tl.load(view + LEAST_SPREAD)
    changed, aside, up, cos, sin, per_squared = turned(view, xx, xy, yy, drawn)
    d_mean = d_xx + d_yy + (xx + yy) * d_det
    d_angle = 2 * least * (cos * d_xy - sin * (d_xx - d_yy)) * per_squared
    d_half = -d_angle * aside  # d up / d half is -1
    d_aside = tl.where(tl.abs(xy) < tl.load(view + LEVEL_BELOW), 0.0, -d_angle * up)
    d_xx, d_yy = tl.where(changed, 0.5 * (d_mean + d_half), d_xx), tl.where(changed, 0.5 * (d_mean - d_half), d_yy)
    return d_xx, tl.where(changed, d_aside, d_xy), d_yy, tl.where(changed, 0.0, d_det)


@triton.jit
def coefficients(view, xx, xy, yy, det):
    """The factors a and b of `limited`, a·shape + b·1; where only the longer axis is clamped; and the variances along both axes."""
    most = tl.load(view + MAX_VARIANCE)
    long = 0.5 * (xx + yy) + spread_of(xx, xy, yy)
    short = det / long
    too_long = long > most
    one_axis = too_long & (short < most)
    most = tl.where(too_long, most, 0.0)  # which may be infinite
    per_difference = 1 / tl.where(one_axis & (long > short), long - short, 1.0)
    a = tl.where(one_axis, (most - short) * per_difference, 0.0)
    b = tl.where(one_axis, short * (long - most) * per_difference, most)
    return tl.where(too_long, a, 1.0), tl.where(too_long, b, 0.0), one_axis, long, short, per_difference


@triton.jit
def shrinking(view, xx, yy):
    """The factor by which a boxed view shrinks whole splats until their variances along x and y fit."""
    most, larger = tl.where(tl.load(view + BOXED) > 0, tl.load(view + MAX_VARIANCE), float("inf")), tl.maximum(xx, yy)
    too_large = larger > most
    return tl.where(too_large, tl.where(too_large, most, 0.0) / larger, 1.0), too_large, larger


@triton.jit
def limited(view, xx, xy, yy, det):
    """The shapes, with the variances along their axes clamped to the largest; a boxed view shrinks whole splats before."""
    factor, _too_large, _larger = shrinking(view, xx, yy)
    xx, xy, yy, det = factor * xx, factor * xy, factor * yy, factor * factor * det
    a, b, _one_axis, _long, _short, _per_difference = coefficients(view, xx, xy, yy, det)
    return a * xx + b, a * xy, a * yy + b, a * a * det + a * b * (xx + yy) + b * b


@triton.jit
def limited_back(view, xx, xy, yy, det, d_xx, d_xy, d_yy, d_det):
    """The gradient of a shape before `limited`."""
    factor, too_large, larger = shrinking(view, xx, yy)
    d_xx, d_xy, d_yy, d_det = clamped_back(view, factor * xx, factor * xy, factor * yy, factor * factor * det, d_xx, d_xy, d_yy, d_det)
    d_factor = d_xx * xx + d_xy * xy + d_yy * yy + d_det * (2 * factor * det)
    d_larger = tl.where(too_large, -d_factor * factor / larger, 0.0)
    d_xx, d_yy = factor * d_xx + tl.where(xx >= yy, d_larger, 0.0), factor * d_yy + tl.where(xx >= yy, 0.0, d_larger)
    return d_xx, factor * d_xy, d_yy, factor * factor * d_det


@triton.jit
def clamped_back(view, xx, xy, yy, det, d_xx, d_xy, d_yy, d_det):
    """The gradient of a shape before its variances are clamped along its axes."""
    a, b, one_axis, long, short, per_difference = coefficients(view, xx, xy, yy, det)
    over_most = tl.where(one_axis, long - tl.load(view + MAX_VARIANCE), 0.0)
    d_a = d_xx * xx + d_xy * xy + d_yy * yy + d_det * (2 * a * det + b * (xx + yy))
    d_b = d_xx + d_yy + d_det * (a * (xx + yy) + 2 * b)
    d_xx, d_xy, d_yy, d_det = a * (d_xx + b * d_det), a * d_xy, a * (d_yy + b * d_det), a * a * d_det
    d_short = (d_b * long - d_a) * over_most * per_difference * per_difference
    d_long = tl.where(one_axis, (d_b * short - d_a) * a * per_difference - d_short * short / long, 0.0)
    d_spread = tl.where(one_axis, 2 * d_long * per_difference, 0.0)
    d_half = d_spread * 0.25 * (xx - yy)
    return d_xx + 0.5 * d_long + d_half, d_xy + d_spread * xy, d_yy + 0.5 * d_long - d_half, d_det + d_short / long
