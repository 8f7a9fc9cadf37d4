"""What a splat shows through the windows of 16 pixels, the windows behind it, and gradients (`splatting.window` has the formulas)."""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

import math

from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, bits, fma, maximum, minimum, select, sqrt
from mipmap_plugin.backends.cpu_kernels.powers import exp2
from mipmap_plugin.effects import MAX_ALPHA
from mipmap_plugin.splatting.window import FARTHEST, LEAST_VARIANCE, POINTS, WEIGHTS, WIDE

HALF_LOG2E = 0.5 / math.log(2)
ALL = (1 << WIDTH) - 1

# px: no corner of a window, turned about its own center, lies further from its pixel's center than this.
CORNER = 2 * FARTHEST

# The normal distribution's tail beyond x over its density is a polynomial of 1 / (1 + TAIL·x), to 7.5e-8 (Abramowitz and Stegun 26.2.17).
TAIL, TAILS = 0.2316419, (0.319381530, -0.356563782, 1.781477937, -1.821255978, 1.330274429)
ROOT = math.sqrt(2 * math.pi)

# log2, what rounding may take off a splat that just reaches a window.
ROUNDING = 1e-3


@inner
def shape_of(splat):
    """Of a row of the table: the direction of the longer axis, whether that is nearer to y, 1 / standard deviation along it and across,
    and the opacity."""
    cos, sin = splat[col.COS], splat[col.SIN]
    return cos, sin, abs(cos) < abs(sin), splat[col.PER_LONG], splat[col.PER_SHORT], splat[col.OPACITY]


@inner
def reached(splat, room, dx, dy, window):
    """Which windows a splat may show 1/255 through: its Gaussian is nowhere higher in a window than at the point nearest to its center.

    `room`: log2 of how far the splat's opacity lies above 1/255.
    """
    cos, sin, upright, per_long, per_short, _ = splat
    x, y, width, height = window
    dx, dy = dx + x, y + dy
    u, v = fma(dx, cos, dy * sin), fma(dy, cos, dx * (0 - sin))
    a, b = (height, width) if upright else (width, height)
    along = maximum(maximum(u, 0 - u) - a * 0.5, 0) * per_long
    across = maximum(maximum(v, 0 - v) - b * 0.5, 0) * per_short
    return fma(along, along, across * across) * HALF_LOG2E < room + ROUNDING


@inner
def look(splat, dx, dy, window):
    """Alpha, not clamped, of a splat through windows (x, y, width, height) of pixels dx, dy px from its center; and what it came from."""
    cos, sin, upright, per_long, per_short, opacity = splat
    x, y, width, height = window
    dx, dy = dx + x, y + dy
    u, v = fma(dx, cos, dy * sin), fma(dy, cos, dx * (0 - sin))
    a, b = (height, width) if upright else (width, height)
    along, across = moments(u, a, per_long), moments(v, b, per_short)
    return along[0] * across[0] * opacity, (u, v, a, b, along, across)


@inner
def behind(splat, window, alpha, seen):
    """The windows behind a splat, before they are kept near their pixels; and how their means and variances came about."""
    cos, sin, upright, _, _, opacity = splat
    x, y, _, _ = window
    _, _, a, b, along, across = seen
    shown = minimum(MAX_ALPHA / (along[0] * across[0]), opacity)
    per_rest = 1 / (1 - minimum(alpha, MAX_ALPHA))
    u, a_variance = left(a, shown * across[0], along, per_rest)
    v, b_variance = left(b, shown * along[0], across, per_rest)
    new_a, new_b = sqrt(maximum(a_variance, LEAST_VARIANCE) * 12), sqrt(maximum(b_variance, LEAST_VARIANCE) * 12)
    x, y = fma(u, cos, fma(v, 0 - sin, x)), fma(u, sin, fma(v, cos, y))
    width, height = (new_b, new_a) if upright else (new_a, new_b)
    return (x, y, width, height), (shown, per_rest, u, v, a_variance, b_variance)


@inner
def left(width, opacity, moment, per_rest):
    """Along one axis, the mean of what is left from the window's center, px, and its variance, px²."""
    mean = 0 - opacity * moment[1] * per_rest
    return mean, (width * width * (1 / 12) - opacity * moment[2]) * per_rest - mean * mean


@inner
def kept(window):
    """Windows near their pixels."""
    x, y, width, height = window
    width, height = minimum(width, 2 * FARTHEST), minimum(height, 2 * FARTHEST)
    return near(x, width), near(y, height), width, height


@inner
def near(center, width):
    room = FARTHEST - width * 0.5
    return minimum(maximum(center, 0 - room), room)


@inner
def moments(u, width, per_sigma):
    """(p, m, q), by `sums` or by `differences`, whichever is right for each lane."""
    wide = width * per_sigma < WIDE
    some = bits(wide)
    if some == ALL:
        return sums(u, width, per_sigma)
    if some == 0:
        return differences(u, width, per_sigma)
    p, m, q = sums(u, width, per_sigma)
    other_p, other_m, other_q = differences(u, width, per_sigma)
    return select(wide, p, other_p), select(wide, m, other_m), select(wide, q, other_q)


@inner
def sums(u, width, per_sigma):
    middle = gaussian(u * per_sigma) * WEIGHTS[2]
    p, m, q = pair(u, width * (0.5 * POINTS[4]), per_sigma, WEIGHTS[4])
    p_, m_, q_ = pair(u, width * (0.5 * POINTS[3]), per_sigma, WEIGHTS[3])
    return middle + p + p_, m + m_, q + q_


@inner
def pair(u, s, per_sigma, weight):
    """What two points s to the left and to the right add."""
    before, after = gaussian((u - s) * per_sigma) * weight, gaussian((u + s) * per_sigma) * weight
    both = before + after
    return both, (after - before) * s, both * s * s


@inner
def differences(u, width, per_sigma):
    sigma = 1 / per_sigma
    first, last = u - width * 0.5, u + width * 0.5
    g_first, g_last = gaussian(first * per_sigma), gaussian(last * per_sigma)
    tail_first, tail_last = tail(first * per_sigma, g_first), tail(last * per_sigma, g_last)
    apart = tail_first - tail_last
    mass = select(first * last < 0, ROOT - tail_first - tail_last, maximum(apart, 0 - apart))
    per_width = 1 / width
    p = mass * sigma * per_width
    m = (g_first - g_last) * per_width * sigma * sigma - u * p
    return p, m, (p - (last * g_last - first * g_first) * per_width) * sigma * sigma - u * fma(m, 2, u * p)


@inner
def gaussian(x):
    return exp2(maximum(x * x * (0 - HALF_LOG2E), -125.0))


@inner
def tail(x, density):
    """√(2π) times the share of the normal distribution beyond |x|."""
    t = 1 / fma(maximum(x, 0 - x), TAIL, 1)
    series = fma(t, TAILS[4], TAILS[3])
    series = fma(series, t, TAILS[2])
    series = fma(series, t, TAILS[1])
    series = fma(series, t, TAILS[0])
    return series * t * density


@inner
def pull_kept(window, d_window):
    """The gradient of windows before `kept`."""
    x, y, width, height = window
    d_x, d_y, d_width, d_height = d_window
    d_x, d_width = pull_near(x, width, d_x, d_width)
    d_y, d_height = pull_near(y, height, d_y, d_height)
    return d_x, d_y, d_width, d_height


@inner
def pull_near(center, width, d_center, d_width):
    room = FARTHEST - minimum(width, 2 * FARTHEST) * 0.5
    held = select(room < center, d_center, select(center < 0 - room, 0 - d_center, 0))  # the gradient of the room
    free = select(room < center, 0, select(center < 0 - room, 0, d_center))
    return free, select(width < 2 * FARTHEST, d_width - held * 0.5, 0)


@inner
def pull_behind(splat, alpha, s, seen, shown, d_window):
    """From s = alpha · dLoss/dalpha and the gradient of the windows behind a splat before `kept`.

    The gradient of the windows in front; s of the opacity; the gradients by u, v, the logarithms of long and short, and the angle.
    """
    cos, sin, upright, per_long, per_short, _ = splat
    u, v, a, b, along, across = seen
    opacity, per_rest, mean_u, mean_v, a_variance, b_variance = shown
    d_x, d_y, d_width, d_height = d_window
    d_mean_u, d_mean_v = fma(d_x, cos, d_y * sin), fma(d_y, cos, d_x * (0 - sin))
    turn = mean_u * d_mean_v - mean_v * d_mean_u
    d_new_a, d_new_b = (d_height, d_width) if upright else (d_width, d_height)
    d_long, d_along, d_a, d_rest_a = pull_left(a, opacity * across[0], along, per_rest, (mean_u, a_variance), d_mean_u, d_new_a)
    d_short, d_across, d_b, d_rest_b = pull_left(b, opacity * along[0], across, per_rest, (mean_v, b_variance), d_mean_v, d_new_b)

    d_opacity = (d_long * across[0] + d_short * along[0]) * opacity
    free = alpha < MAX_ALPHA
    whole = select(free, s - alpha * (d_rest_a + d_rest_b), 0 - d_opacity)
    d_u, d_a_more, grow_long = pull_moments(u, a, per_long, along, (whole / along[0] + d_short * opacity, d_along[0], d_along[1]))
    d_v, d_b_more, grow_short = pull_moments(v, b, per_short, across, (whole / across[0] + d_long * opacity, d_across[0], d_across[1]))
    d_a, d_b = d_a + d_a_more, d_b + d_b_more
    d_x, d_y = d_x + fma(d_u, cos, d_v * (0 - sin)), d_y + fma(d_u, sin, d_v * cos)
    d_width, d_height = (d_b, d_a) if upright else (d_a, d_b)
    turn = turn + d_u * v - d_v * u
    return (d_x, d_y, d_width, d_height), select(free, whole + d_opacity, 0), (d_u, d_v, grow_long, grow_short, turn)


@inner
def pull_left(width, opacity, moment, per_rest, outcome, d_mean, d_new):
    """The gradients of `left`'s opacity, of its moments m and q, of the width, and of the rest, 1 - alpha."""
    mean, variance = outcome
    d_variance = select(variance < LEAST_VARIANCE, 0, 6 * d_new / sqrt(maximum(variance, LEAST_VARIANCE) * 12))
    d_mean = d_mean - mean * d_variance * 2
    d_opacity = 0 - (moment[1] * d_mean + moment[2] * d_variance) * per_rest
    d_m, d_q = 0 - opacity * per_rest * d_mean, 0 - opacity * per_rest * d_variance
    d_rest = 0 - (mean * d_mean + fma(mean, mean, variance) * d_variance) * per_rest
    return d_opacity, (d_m, d_q), d_variance * per_rest * width * (1 / 6), d_rest


@inner
def pull_moments(u, width, per_sigma, moment, d_moment):
    """The gradients by u, the width and log sigma, of `sums` or of `differences`, whichever is right for each lane."""
    wide = width * per_sigma < WIDE
    some = bits(wide)
    if some == ALL:
        return pull_sums(u, width, per_sigma, d_moment)
    if some == 0:
        return pull_differences(u, width, per_sigma, moment, d_moment)
    d_u, d_width, grow = pull_sums(u, width, per_sigma, d_moment)
    other_u, other_width, other_grow = pull_differences(u, width, per_sigma, moment, d_moment)
    return select(wide, d_u, other_u), select(wide, d_width, other_width), select(wide, grow, other_grow)


@inner
def pull_sums(u, width, per_sigma, d_moment):
    """Point by point: across a window that is narrow for its splat, the Gaussian's values at both ends differ by no more than rounding."""
    d_u, d_width, grow = pull_point(u, width * 0, per_sigma, WEIGHTS[2], d_moment)
    for k in (0, 1, 3, 4):
        more_u, more_width, more_grow = pull_point(u, width * (0.5 * POINTS[k]), per_sigma, WEIGHTS[k], d_moment)
        d_u, d_width, grow = d_u + more_u, d_width + more_width, grow + more_grow
    return d_u, d_width / width, grow


@inner
def pull_point(u, s, per_sigma, weight, d_moment):
    """What one point adds to the gradients by u, the logarithm of the width, and log sigma."""
    d_p, d_m, d_q = d_moment
    t = (u + s) * per_sigma
    g = gaussian(t) * weight
    fall = fma(fma(d_q, s, d_m), s, d_p) * g * t
    d_u = 0 - fall * per_sigma
    return d_u, fma(fma(d_q, s * 2, d_m), g, d_u) * s, fall * t


@inner
def pull_differences(u, width, per_sigma, moment, d_moment):
    """From both ends. p, m and q have the degrees 0, 1 and 2 in (u, width, sigma): Euler gives the third gradient."""
    p, m, q = moment
    d_p, d_m, d_q = d_moment
    first, last = gaussian((u - width * 0.5) * per_sigma), gaussian((u + width * 0.5) * per_sigma)
    mean, rise = (first + last) * 0.5, last - first
    per_width = 1 / width
    bend = mean - p
    d_u = d_p * rise * per_width + d_m * bend + d_q * (width * rise * 0.25 - m * 2)
    d_width = (d_p * bend + d_m * (width * rise * 0.25 - m) + d_q * (width * width * mean * 0.25 - q)) * per_width
    return d_u, d_width, d_m * m + d_q * q * 2 - u * d_u - width * d_width
