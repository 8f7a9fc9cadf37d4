"""A splat's integral over the windows of 16 pixels, the windows behind it, and the gradients (formulas: `splatting.window`)."""

# numba redefines calls and operators.
# mypy: ignore-errors

import math

from mipmap_plugin.backends.cpu_kernels import inner, layout
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, bits, fma, maximum, minimum, select, sqrt
from mipmap_plugin.backends.cpu_kernels.powers import HALF_LOG2E, LARGEST_POWER, exp2
from mipmap_plugin.render_settings import MAX_ALPHA
from mipmap_plugin.splatting.window import FARTHEST, LEAST_VARIANCE, POINTS, WEIGHTS, WIDE

ALL = (1 << WIDTH) - 1

# px: a bound on the distance from a pixel's center to a corner of its window, rotated by any angle about the window's own center.
CORNER = 2 * FARTHEST

# The normal distribution's tail beyond x over its density is a polynomial of 1 / (1 + TAIL·x), to 7.5e-8 (Abramowitz and Stegun 26.2.17).
TAIL, TAILS = 0.2316419, (0.319381530, -0.356563782, 1.781477937, -1.821255978, 1.330274429)
ROOT = math.sqrt(2 * math.pi)

# log2: allowance for rounding, so that no splat that just reaches a window is missed.
ROUNDING = 1e-3


@inner
def splat_parameters(splat):
    """From a row of the splat table: the longer axis's direction, whether it is closer to y, 1 / both standard deviations, the opacity."""
    cos, sin = splat[layout.COS], splat[layout.SIN]
    return cos, sin, abs(cos) < abs(sin), splat[layout.PER_LONG], splat[layout.PER_SHORT], splat[layout.OPACITY]


@inner
def may_reach(splat, margin, dx, dy, window):
    """Through which windows alpha may reach 1/255: the Gaussian is nowhere higher in a window than at the point nearest to its center.

    `margin`: log2 of the splat's opacity over 1/255.
    """
    cos, sin, upright, per_long, per_short, _ = splat
    x, y, width, height = window
    dx, dy = dx + x, y + dy
    u, v = fma(dx, cos, dy * sin), fma(dy, cos, dx * (0 - sin))
    a, b = (height, width) if upright else (width, height)
    along = maximum(maximum(u, 0 - u) - a * 0.5, 0) * per_long
    across = maximum(maximum(v, 0 - v) - b * 0.5, 0) * per_short
    return fma(along, along, across * across) * HALF_LOG2E < margin + ROUNDING


@inner
def integrate(splat, dx, dy, window):
    """Alpha, not clamped, through windows (x, y, width, height) of pixels dx, dy px from the center; and the terms it comes from."""
    cos, sin, upright, per_long, per_short, opacity = splat
    x, y, width, height = window
    dx, dy = dx + x, y + dy
    u, v = fma(dx, cos, dy * sin), fma(dy, cos, dx * (0 - sin))
    a, b = (height, width) if upright else (width, height)
    along, across = moments(u, a, per_long), moments(v, b, per_short)
    return along[0] * across[0] * opacity, (u, v, a, b, along, across)


@inner
def windows_behind(splat, window, alpha, integral):
    """The windows behind a splat, before `clamp_window`; and the means and variances they come from."""
    cos, sin, upright, _, _, opacity = splat
    x, y, _, _ = window
    _, _, a, b, along, across = integral
    clamped = minimum(MAX_ALPHA / (along[0] * across[0]), opacity)
    per_rest = 1 / (1 - minimum(alpha, MAX_ALPHA))
    u, a_variance = behind_on_axis(a, clamped * across[0], along, per_rest)
    v, b_variance = behind_on_axis(b, clamped * along[0], across, per_rest)
    new_a, new_b = sqrt(maximum(a_variance, LEAST_VARIANCE) * 12), sqrt(maximum(b_variance, LEAST_VARIANCE) * 12)
    x, y = fma(u, cos, fma(v, 0 - sin, x)), fma(u, sin, fma(v, cos, y))
    width, height = (new_b, new_a) if upright else (new_a, new_b)
    return (x, y, width, height), (clamped, per_rest, u, v, a_variance, b_variance)


@inner
def behind_on_axis(width, opacity, moment, per_rest):
    """The mean and variance of the transmittance behind a splat along one axis: px from the window's center, and px²."""
    mean = 0 - opacity * moment[1] * per_rest
    return mean, (width * width * (1 / 12) - opacity * moment[2]) * per_rest - mean * mean


@inner
def clamp_window(window):
    """Clamp windows to FARTHEST from their pixels' centers."""
    x, y, width, height = window
    width, height = minimum(width, 2 * FARTHEST), minimum(height, 2 * FARTHEST)
    return clamp_center(x, width), clamp_center(y, height), width, height


@inner
def clamp_center(center, width):
    """Move a window's center along one axis so that the window stays within FARTHEST of its pixel's center."""
    room = FARTHEST - width * 0.5
    return minimum(maximum(center, 0 - room), room)


@inner
def moments(u, width, per_sigma):
    """(p, m, q), by `quadrature` or by `differences`, whichever is accurate for each lane."""
    wide = width * per_sigma < WIDE
    wide_lanes = bits(wide)
    if wide_lanes == ALL:
        return quadrature(u, width, per_sigma)
    if wide_lanes == 0:
        return differences(u, width, per_sigma)
    p, m, q = quadrature(u, width, per_sigma)
    other_p, other_m, other_q = differences(u, width, per_sigma)
    return select(wide, p, other_p), select(wide, m, other_m), select(wide, q, other_q)


@inner
def quadrature(u, width, per_sigma):
    """`moments` by five-point Gauss-Legendre quadrature."""
    middle = gaussian(u * per_sigma) * WEIGHTS[2]
    p, m, q = point_pair(u, width * (0.5 * POINTS[4]), per_sigma, WEIGHTS[4])
    p_, m_, q_ = point_pair(u, width * (0.5 * POINTS[3]), per_sigma, WEIGHTS[3])
    return middle + p + p_, m + m_, q + q_


@inner
def point_pair(u, s, per_sigma, weight):
    """The terms of the two points at distance s from the middle."""
    before, after = gaussian((u - s) * per_sigma) * weight, gaussian((u + s) * per_sigma) * weight
    pair_sum = before + after
    return pair_sum, (after - before) * s, pair_sum * s * s


@inner
def differences(u, width, per_sigma):
    """`moments` from the Gaussian and its integral at both ends of the window."""
    sigma = 1 / per_sigma
    first, last = u - width * 0.5, u + width * 0.5
    g_first, g_last = gaussian(first * per_sigma), gaussian(last * per_sigma)
    tail_first, tail_last = tail(first * per_sigma, g_first), tail(last * per_sigma, g_last)
    difference = tail_first - tail_last
    mass = select(first * last < 0, ROOT - tail_first - tail_last, maximum(difference, 0 - difference))
    per_width = 1 / width
    p = mass * sigma * per_width
    m = (g_first - g_last) * per_width * sigma * sigma - u * p
    return p, m, (p - (last * g_last - first * g_first) * per_width) * sigma * sigma - u * fma(m, 2, u * p)


@inner
def gaussian(x):
    return exp2(maximum(x * x * (0 - HALF_LOG2E), 0 - LARGEST_POWER))


@inner
def tail(x, density):
    """√(2π) times the normal distribution's probability beyond |x|; density: `gaussian(x)`."""
    t = 1 / fma(maximum(x, 0 - x), TAIL, 1)
    series = fma(t, TAILS[4], TAILS[3])
    series = fma(series, t, TAILS[2])
    series = fma(series, t, TAILS[1])
    series = fma(series, t, TAILS[0])
    return series * t * density


@inner
def grad_clamp_window(window, d_window):
    """The gradient of windows before `clamp_window`."""
    x, y, width, height = window
    d_x, d_y, d_width, d_height = d_window
    d_x, d_width = grad_clamp_center(x, width, d_x, d_width)
    d_y, d_height = grad_clamp_center(y, height, d_y, d_height)
    return d_x, d_y, d_width, d_height


@inner
def grad_clamp_center(center, width, d_center, d_width):
    """The gradients by `clamp_center`'s center and by the width before `clamp_window`."""
    room = FARTHEST - minimum(width, 2 * FARTHEST) * 0.5
    d_room = select(room < center, d_center, select(center < 0 - room, 0 - d_center, 0))  # the gradient of `room`
    d_free = select(room < center, 0, select(center < 0 - room, 0, d_center))
    return d_free, select(width < 2 * FARTHEST, d_width - d_room * 0.5, 0)


@inner
def grad_windows_behind(splat, alpha, s, integral, behind, d_window):
    """The gradients through a splat, from s = alpha · dLoss/dalpha and the gradient of the windows behind it, before `clamp_window`.

    Returns the gradient of the windows in front; opacity · dLoss/dopacity; the gradients by u, v, log long, log short and the angle.
    """
    cos, sin, upright, per_long, per_short, _ = splat
    u, v, a, b, along, across = integral
    opacity, per_rest, mean_u, mean_v, a_variance, b_variance = behind
    d_x, d_y, d_width, d_height = d_window
    d_mean_u, d_mean_v = fma(d_x, cos, d_y * sin), fma(d_y, cos, d_x * (0 - sin))
    d_angle = mean_u * d_mean_v - mean_v * d_mean_u
    d_new_a, d_new_b = (d_height, d_width) if upright else (d_width, d_height)
    d_opacity_long, d_along, d_a, d_rest_a = grad_behind_on_axis(a, opacity * across[0], along, per_rest, (mean_u, a_variance), d_mean_u, d_new_a)
    d_opacity_short, d_across, d_b, d_rest_b = grad_behind_on_axis(b, opacity * along[0], across, per_rest, (mean_v, b_variance), d_mean_v, d_new_b)

    d_opacity = (d_opacity_long * across[0] + d_opacity_short * along[0]) * opacity
    unclamped = alpha < MAX_ALPHA
    d_log_alpha = select(unclamped, s - alpha * (d_rest_a + d_rest_b), 0 - d_opacity)
    d_u, d_a_more, d_log_long = grad_moments(u, a, per_long, along, (d_log_alpha / along[0] + d_opacity_short * opacity, d_along[0], d_along[1]))
    d_v, d_b_more, d_log_short = grad_moments(v, b, per_short, across, (d_log_alpha / across[0] + d_opacity_long * opacity, d_across[0], d_across[1]))
    d_a, d_b = d_a + d_a_more, d_b + d_b_more
    d_x, d_y = d_x + fma(d_u, cos, d_v * (0 - sin)), d_y + fma(d_u, sin, d_v * cos)
    d_width, d_height = (d_b, d_a) if upright else (d_a, d_b)
    d_angle = d_angle + d_u * v - d_v * u
    return (d_x, d_y, d_width, d_height), select(unclamped, d_log_alpha + d_opacity, 0), (d_u, d_v, d_log_long, d_log_short, d_angle)


@inner
def grad_behind_on_axis(width, opacity, moment, per_rest, behind, d_mean, d_new):
    """The gradients of `behind_on_axis` by the opacity, the moments m and q, the width, and 1 - alpha."""
    mean, variance = behind
    d_variance = select(variance < LEAST_VARIANCE, 0, 6 * d_new / sqrt(maximum(variance, LEAST_VARIANCE) * 12))
    d_mean = d_mean - mean * d_variance * 2
    d_opacity = 0 - (moment[1] * d_mean + moment[2] * d_variance) * per_rest
    d_m, d_q = 0 - opacity * per_rest * d_mean, 0 - opacity * per_rest * d_variance
    d_rest = 0 - (mean * d_mean + fma(mean, mean, variance) * d_variance) * per_rest
    return d_opacity, (d_m, d_q), d_variance * per_rest * width * (1 / 6), d_rest


@inner
def grad_moments(u, width, per_sigma, moment, d_moment):
    """The gradients by u, the width and log sigma, of `quadrature` or of `differences`, whichever is accurate for each lane."""
    wide = width * per_sigma < WIDE
    wide_lanes = bits(wide)
    if wide_lanes == ALL:
        return grad_quadrature(u, width, per_sigma, d_moment)
    if wide_lanes == 0:
        return grad_differences(u, width, per_sigma, moment, d_moment)
    d_u, d_width, d_log_sigma = grad_quadrature(u, width, per_sigma, d_moment)
    other_u, other_width, other_log_sigma = grad_differences(u, width, per_sigma, moment, d_moment)
    return select(wide, d_u, other_u), select(wide, d_width, other_width), select(wide, d_log_sigma, other_log_sigma)


@inner
def grad_quadrature(u, width, per_sigma, d_moment):
    """`grad_moments` point by point: a window that is narrow for its splat has almost equal values at both ends, so their difference would cancel."""
    d_u, d_width, d_log_sigma = grad_quadrature_point(u, width * 0, per_sigma, WEIGHTS[2], d_moment)
    for k in (0, 1, 3, 4):
        more_u, more_width, more_log_sigma = grad_quadrature_point(u, width * (0.5 * POINTS[k]), per_sigma, WEIGHTS[k], d_moment)
        d_u, d_width, d_log_sigma = d_u + more_u, d_width + more_width, d_log_sigma + more_log_sigma
    return d_u, d_width / width, d_log_sigma


@inner
def grad_quadrature_point(u, s, per_sigma, weight, d_moment):
    """One point's terms of the gradients by u, the logarithm of the width, and log sigma."""
    d_p, d_m, d_q = d_moment
    t = (u + s) * per_sigma
    g = gaussian(t) * weight
    decay = fma(fma(d_q, s, d_m), s, d_p) * g * t
    d_u = 0 - decay * per_sigma
    return d_u, fma(fma(d_q, s * 2, d_m), g, d_u) * s, decay * t


@inner
def grad_differences(u, width, per_sigma, moment, d_moment):
    """`grad_moments` from the values at both ends.

    p, m and q are homogeneous of degrees 0, 1 and 2 in (u, width, sigma), so Euler's theorem gives the gradient by sigma.
    """
    p, m, q = moment
    d_p, d_m, d_q = d_moment
    first, last = gaussian((u - width * 0.5) * per_sigma), gaussian((u + width * 0.5) * per_sigma)
    mean, rise = (first + last) * 0.5, last - first
    per_width = 1 / width
    mean_less_p = mean - p
    d_u = d_p * rise * per_width + d_m * mean_less_p + d_q * (width * rise * 0.25 - m * 2)
    d_width = (d_p * mean_less_p + d_m * (width * rise * 0.25 - m) + d_q * (width * width * mean * 0.25 - q)) * per_width
    return d_u, d_width, d_m * m + d_q * q * 2 - u * d_u - width * d_width
