"""Culling, stretching and limiting of splats on the image, and the gradients (formulas: `splatting.culls`).

All numbers are lanes of float64. Shapes are (xx, xy, yy, det) as in `ellipses`, after dilation.
"""

# numba redefines calls and operators.
# mypy: ignore-errors


from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.lanes import both, maximum, minimum, narrow, select, sqrt, wide
from mipmap_plugin.backends.cpu_kernels.powers import exp2, log2
from mipmap_plugin.splatting.culls import ASIDE, STEEPNESS

# The ratio for a limit that is not set: greater than any other.
NO_LIMIT = 1e300

# Outside these ratios of measure and threshold the slope of the gate is 0 to within 1e-10.
MIN_RATIO, MAX_RATIO = 1e-3, 1e3


@inner
def ratios(view, shape, opacity):
    """Measure over threshold for size, contribution and elongation; and half the difference of the variances along the axes."""
    xx, xy, yy, det = shape
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    spread = sqrt(half * half + xy * xy)
    size = contribution = elongation = mean * 0 + NO_LIMIT
    if view.min_variance > 0:
        size = (maximum(xx, yy) if view.boxed else mean + spread) / view.min_variance
    if view.min_contribution > 0:
        contribution = (sqrt(opacity) if view.rooted else opacity) * sqrt(det) / view.min_contribution
    if view.least_spread > 0:
        elongation = mean / view.least_spread
    return size, contribution, elongation, spread


@inner
def is_drawn(view, shape, opacity):
    """Which splats are not culled."""
    size, contribution, elongation, _ = ratios(view, shape, opacity)
    return minimum(minimum(size, contribution), elongation) >= 1


@inner
def grad_gate(view, shape, opacity, d_gate):
    """The gradients of a shape and its opacity from that of its gate, through the rule with the least ratio."""
    xx, xy, yy, det = shape
    size, contribution, elongation, spread = ratios(view, shape, opacity)
    least = minimum(minimum(size, contribution), elongation)
    smooth = smooth_step(least)
    d_log = d_gate * STEEPNESS * smooth * (1 - smooth)  # by the logarithm of the least ratio
    d_size = select(size <= least, d_log, 0.0)
    d_contribution = select(both(size > least, contribution <= least), d_log, 0.0)
    d_elongation = select(both(both(size > least, contribution > least), elongation <= least), d_log, 0.0)

    per_mean = 0.5 / (xx + yy)
    d_xx = d_yy = d_elongation * (2 * per_mean)
    d_xy = d_xx * 0
    if view.boxed:
        d_xx, d_yy = d_xx + select(xx >= yy, d_size / xx, 0.0), d_yy + select(xx >= yy, 0.0, d_size / yy)
    else:
        d_longer = d_size / (0.5 * (xx + yy) + spread)
        d_per_spread = select(spread > 0, d_longer / select(spread > 0, spread, 1.0), 0.0)
        d_half = d_per_spread * 0.5 * (xx - yy)
        d_xx, d_yy, d_xy = d_xx + 0.5 * (d_longer + d_half), d_yy + 0.5 * (d_longer - d_half), d_per_spread * xy
    power = 0.5 if view.rooted else 1.0
    d_opacity = select(opacity > 0, d_contribution * power / select(opacity > 0, opacity, 1.0), 0.0)
    return (d_xx, d_xy, d_yy, 0.5 * d_contribution / det), d_opacity


@inner
def smooth_step(ratio):
    """The logistic function of STEEPNESS · ln(ratio)."""
    power = log2(minimum(maximum(ratio, MIN_RATIO), MAX_RATIO)) * STEEPNESS
    return 1 / (1 + wide(exp2(narrow(0 - power))))


@inner
def stretched(view, shape, drawn):
    """The shapes of drawn splats, stretched where half the difference of their variances is below `least_spread`; and which those are."""
    xx, xy, yy, det = shape
    least_spread, mean, half = view.least_spread, 0.5 * (xx + yy), 0.5 * (xx - yy)
    changed = both(drawn, half * half + xy * xy < least_spread * least_spread)
    up, aside = least_spread - half, select(maximum(xy, 0 - xy) < view.level_below, ASIDE * least_spread, xy)
    per_squared = least_spread / select(changed, aside * aside + up * up, 1.0)
    cos, sin = (aside * aside - up * up) * per_squared, 2 * aside * up * per_squared
    new = mean * mean - least_spread * least_spread
    return (select(changed, mean + cos, xx), select(changed, sin, xy), select(changed, mean - cos, yy), select(changed, new, det)), changed


@inner
def grad_stretched(view, shape, changed, d_shape):
    """The gradient of a shape before `stretched`, through its mean and the angle of (aside, up); (cos, sin) have twice that angle."""
    xx, xy, yy, _ = shape
    d_xx, d_xy, d_yy, d_det = d_shape
    least_spread, mean, up = view.least_spread, 0.5 * (xx + yy), view.least_spread - 0.5 * (xx - yy)
    level = maximum(xy, 0 - xy) < view.level_below
    aside = select(level, ASIDE * least_spread, xy)
    per_squared = 1 / select(changed, aside * aside + up * up, 1.0)
    cos, sin = (aside * aside - up * up) * per_squared, 2 * aside * up * per_squared
    d_mean = d_xx + d_yy + 2 * mean * d_det
    d_angle = 2 * least_spread * (cos * d_xy - sin * (d_xx - d_yy)) * per_squared
    d_half = 0 - d_angle * aside  # d up / d half is -1
    return (
        select(changed, 0.5 * (d_mean + d_half), d_xx),
        select(changed, select(level, 0.0, 0 - d_angle * up), d_xy),
        select(changed, 0.5 * (d_mean - d_half), d_yy),
        select(changed, 0.0, d_det),
    )


@inner
def limited(view, shape):
    """The shapes, with variances clamped to `max_variance`: a·shape + b·1; a boxed view shrinks whole splats before."""
    if view.boxed:
        shape = shrunk(view, shape)
    a, b, _, _, _ = coefficients(view, shape)
    return affine(shape, a, b)


@inner
def shrunk(view, shape):
    """The shapes, shrunk until their variances along x and y fit."""
    xx, _, yy, _ = shape
    larger = maximum(xx, yy)
    return affine(shape, select(larger > view.max_variance, view.max_variance / larger, 1.0), xx * 0)


@inner
def affine(shape, a, b):
    """a·shape + b·1."""
    xx, xy, yy, det = shape
    return a * xx + b, a * xy, a * yy + b, a * a * det + a * b * (xx + yy) + b * b


@inner
def coefficients(view, shape):
    """The factors a and b of `limited`; where only the longer axis is clamped; and the variances along both axes."""
    xx, xy, yy, det = shape
    max_variance, half = view.max_variance, 0.5 * (xx - yy)
    long = 0.5 * (xx + yy) + sqrt(half * half + xy * xy)
    short = det / long
    too_long = long > max_variance
    zero = xx * 0
    one_axis = both(too_long, short < max_variance)
    per_difference = 1 / select(one_axis, long - short, 1.0)
    a = select(one_axis, (max_variance - short) * per_difference, select(too_long, zero, 1.0))
    return a, select(one_axis, short * (long - max_variance) * per_difference, select(too_long, max_variance, zero)), one_axis, long, short


@inner
def grad_limited(view, shape, d_limited):
    """The gradient of a shape before `limited`."""
    if view.boxed:
        return grad_shrunk(view, shape, grad_clamped(view, shrunk(view, shape), d_limited))
    return grad_clamped(view, shape, d_limited)


@inner
def grad_shrunk(view, shape, d_shrunk):
    """The gradient of a shape before `shrunk`."""
    xx, xy, yy, det = shape
    d_xx, d_xy, d_yy, d_det = d_shrunk
    larger = maximum(xx, yy)
    too_large = larger > view.max_variance
    factor = select(too_large, view.max_variance / larger, 1.0)
    d_factor = d_xx * xx + d_xy * xy + d_yy * yy + d_det * (2 * factor * det)
    d_larger = select(too_large, 0 - d_factor * factor / larger, 0.0)
    d_xx, d_yy = factor * d_xx + select(xx >= yy, d_larger, 0.0), factor * d_yy + select(xx >= yy, 0.0, d_larger)
    return d_xx, factor * d_xy, d_yy, factor * factor * d_det


@inner
def grad_clamped(view, shape, d_limited):
    """The gradient of a shape before its variances are clamped along its axes."""
    xx, xy, yy, det = shape
    d_xx, d_xy, d_yy, d_det = d_limited
    max_variance, half = view.max_variance, 0.5 * (xx - yy)
    a, b, one_axis, long, short = coefficients(view, shape)
    d_a = d_xx * xx + d_xy * xy + d_yy * yy + d_det * (2 * a * det + b * (xx + yy))
    d_b = d_xx + d_yy + d_det * (a * (xx + yy) + 2 * b)
    d_xx, d_xy, d_yy, d_det = a * (d_xx + b * d_det), a * d_xy, a * (d_yy + b * d_det), a * a * d_det
    per_difference = 1 / select(one_axis, long - short, 1.0)
    d_short = select(one_axis, (d_b * long - d_a) * (long - max_variance) * per_difference * per_difference, 0.0)
    d_long = select(one_axis, (d_b * short - d_a) * a * per_difference, 0.0) - d_short * short / long
    per_spread = select(one_axis, 2 * d_long * per_difference, 0.0)
    d_half = 0.5 * per_spread * half
    return d_xx + 0.5 * d_long + d_half, d_xy + per_spread * xy, d_yy + 0.5 * d_long - d_half, d_det + d_short / long
