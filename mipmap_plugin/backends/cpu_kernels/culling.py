"""Culls and stretches of 16 splats on the image, and the way back for gradients (`splatting.culls` has the formulas).

All numbers are lanes of float64. Shapes are (xx, xy, yy, det) as in `ellipses`, after dilation.
"""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

import math

from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.lanes import both, maximum, minimum, narrow, select, sqrt, wide
from mipmap_plugin.backends.cpu_kernels.powers import exp2, log2
from mipmap_plugin.splatting.culls import STEEPNESS

LOG2E = 1 / math.log(2)

# A quotient that nothing reaches: the rule is not asked for.
NO_RULE = 1e300

# Beyond these quotients of measure and threshold the slope of the gate is 0 to within 1e-10.
NARROWEST, WIDEST = 1e-3, 1e3


@inner
def quotients(view, shape, opacity):
    """Of size, contribution and spread: measure over threshold. And half the difference of the variances along the axes."""
    xx, xy, yy, det = shape
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    spread = sqrt(half * half + xy * xy)
    size = light = stretch = mean * 0 + NO_RULE
    if view.min_variance > 0:
        size = (maximum(xx, yy) if view.boxed else mean + spread) / view.min_variance
    if view.min_contribution > 0:
        light = opacity * sqrt(det) / view.min_contribution
    if view.least_spread > 0:
        stretch = mean / view.least_spread
    return size, light, stretch, spread


@inner
def is_drawn(view, shape, opacity):
    """Which splats are not culled."""
    size, light, stretch, _ = quotients(view, shape, opacity)
    return minimum(minimum(size, light), stretch) >= 1


@inner
def pull_gate(view, shape, opacity, d_gate):
    """The gradients of a shape and of its opacity from that of its gate: of the rule that is nearest to culling it."""
    xx, xy, yy, det = shape
    size, light, stretch, spread = quotients(view, shape, opacity)
    least = minimum(minimum(size, light), stretch)
    smooth = step(least)
    d_log = d_gate * STEEPNESS * smooth * (1 - smooth)  # of the logarithm of the least quotient
    d_size = select(size <= least, d_log, 0.0)
    d_light = select(both(size > least, light <= least), d_log, 0.0)
    d_stretch = select(both(both(size > least, light > least), stretch <= least), d_log, 0.0)

    per_mean = 0.5 / (xx + yy)
    d_xx = d_yy = d_stretch * (2 * per_mean)
    d_xy = d_xx * 0
    if view.boxed:
        d_xx, d_yy = d_xx + select(xx >= yy, d_size / xx, 0.0), d_yy + select(xx >= yy, 0.0, d_size / yy)
    else:
        d_longer = d_size / (0.5 * (xx + yy) + spread)
        lean = select(spread > 0, d_longer / select(spread > 0, spread, 1.0), 0.0)
        d_half = lean * 0.5 * (xx - yy)
        d_xx, d_yy, d_xy = d_xx + 0.5 * (d_longer + d_half), d_yy + 0.5 * (d_longer - d_half), lean * xy
    d_opacity = select(opacity > 0, d_light / select(opacity > 0, opacity, 1.0), 0.0)
    return (d_xx, d_xy, d_yy, 0.5 * d_light / det), d_opacity


@inner
def step(quotient):
    """The logistic function of STEEPNESS · ln(quotient)."""
    power = log2(minimum(maximum(quotient, NARROWEST), WIDEST)) * STEEPNESS
    return 1 / (1 + wide(exp2(narrow(0 - power))))


@inner
def stretched(view, shape, drawn):
    """The shapes of splats whose variances are put further from their mean, and which those are."""
    xx, xy, yy, det = shape
    least, mean, half = view.least_spread, 0.5 * (xx + yy), 0.5 * (xx - yy)
    changed = both(drawn, half * half + xy * xy < least * least)
    up = least - half
    per_squared = least / select(changed, xy * xy + up * up, 1.0)
    cos, sin = (xy * xy - up * up) * per_squared, 2 * xy * up * per_squared
    new = mean * mean - least * least
    return (select(changed, mean + cos, xx), select(changed, sin, xy), select(changed, mean - cos, yy), select(changed, new, det)), changed


@inner
def pull_stretched(view, shape, changed, d_shape):
    """The gradient of a shape before it was stretched: its mean, and the angle of (xy, up), of which (cos, sin) have twice."""
    xx, xy, yy, _ = shape
    d_xx, d_xy, d_yy, d_det = d_shape
    least, mean, up = view.least_spread, 0.5 * (xx + yy), view.least_spread - 0.5 * (xx - yy)
    per_squared = 1 / select(changed, xy * xy + up * up, 1.0)
    cos, sin = (xy * xy - up * up) * per_squared, 2 * xy * up * per_squared
    d_mean = d_xx + d_yy + 2 * mean * d_det
    d_angle = 2 * least * (cos * d_xy - sin * (d_xx - d_yy)) * per_squared
    d_half = 0 - d_angle * xy  # up falls as half rises
    return (
        select(changed, 0.5 * (d_mean + d_half), d_xx),
        select(changed, 0 - d_angle * up, d_xy),
        select(changed, 0.5 * (d_mean - d_half), d_yy),
        select(changed, 0.0, d_det),
    )


@inner
def limited(view, shape):
    """The shapes of splats that are made smaller where they are too large: a·shape + b·1."""
    a, b, _, _, _ = factors(view, shape)
    return scaled(shape, a, b)


@inner
def scaled(shape, a, b):
    xx, xy, yy, det = shape
    return a * xx + b, a * xy, a * yy + b, a * a * det + a * b * (xx + yy) + b * b


@inner
def factors(view, shape):
    """The numbers a and b of `limited`; where only the longer axis is too long; and the variances along both."""
    xx, xy, yy, det = shape
    most, half = view.max_variance, 0.5 * (xx - yy)
    long = maximum(xx, yy) if view.boxed else 0.5 * (xx + yy) + sqrt(half * half + xy * xy)
    short = det / long
    large = long > most
    nothing = xx * 0
    if view.boxed:
        return select(large, most / long, 1.0), nothing, large, long, short
    one = both(large, short < most)
    per_apart = 1 / select(one, long - short, 1.0)
    a = select(one, (most - short) * per_apart, select(large, nothing, 1.0))
    return a, select(one, short * (long - most) * per_apart, select(large, most, nothing)), one, long, short


@inner
def pull_limited(view, shape, d_limited):
    """The gradient of a shape before it was limited."""
    xx, xy, yy, det = shape
    d_xx, d_xy, d_yy, d_det = d_limited
    most, half = view.max_variance, 0.5 * (xx - yy)
    a, b, one, long, short = factors(view, shape)
    d_a = d_xx * xx + d_xy * xy + d_yy * yy + d_det * (2 * a * det + b * (xx + yy))
    d_b = d_xx + d_yy + d_det * (a * (xx + yy) + 2 * b)
    d_xx, d_xy, d_yy, d_det = a * (d_xx + b * d_det), a * d_xy, a * (d_yy + b * d_det), a * a * d_det
    if view.boxed:
        d_long = select(one, 0 - d_a * a / long, 0.0)
        return d_xx + select(xx >= yy, d_long, 0.0), d_xy, d_yy + select(xx >= yy, 0.0, d_long), d_det
    per_apart = 1 / select(one, long - short, 1.0)
    d_short = select(one, (d_b * long - d_a) * (long - most) * per_apart * per_apart, 0.0)
    d_long = select(one, (d_b * short - d_a) * a * per_apart, 0.0) - d_short * short / long
    per_spread = select(one, 2 * d_long * per_apart, 0.0)
    lean = 0.5 * per_spread * half
    return d_xx + 0.5 * d_long + lean, d_xy + per_spread * xy, d_yy + 0.5 * d_long - lean, d_det + d_short / long
