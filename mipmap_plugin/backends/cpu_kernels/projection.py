"""Splats in the world -> rows of the splat table, 16 at a time. Geometry in float64: with less, needles and far splats are lost."""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

import math

import numpy as np
from numba import types

from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels import culling, ellipses, harmonics, inner, integrals, kernel, windows
from mipmap_plugin.backends.cpu_kernels.binning import count_tiles
from mipmap_plugin.backends.cpu_kernels.blocks import get, get_vector, put
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, bits, both, lowest, maximum, narrow, select, spread, sqrt
from mipmap_plugin.backends.cpu_kernels.memory import pointer, scratch
from mipmap_plugin.backends.cpu_kernels.powers import log2
from mipmap_plugin.backends.cpu_kernels.records import SEEN_AT_CENTER, SEEN_IN_PIXEL
from mipmap_plugin.backends.cpu_kernels.tuples import apply, dot, minus, plus, times
from mipmap_plugin.effects import MIN_ALPHA

# -q/2 = -HALF_LOG2E · q in powers of two.
HALF_LOG2E = 0.5 / math.log(2)

# Sizes (px, px²) and brightnesses beyond this are as good as infinite: float32 could not carry their squares.
FAR = 1e30

# The least color that is not black, and the share of the largest color that is not the largest, in float32.
TINY, BELOW = 1e-30, 1 - 1e-7

# A block of what is known of splats in the world, float64: the columns of `Splats`, of which shapes are a covariance or the other two.
MEAN, OPACITY, COVARIANCE, QUAT, SCALE = 0, 3, 4, 4, 8
WORLD = 13

new_world, new_numbers = scratch(WORLD * WIDTH, types.float64), scratch(2 * WIDTH, types.float64)
new_block, new_bands = scratch(col.COLUMNS * WIDTH, types.float32), scratch(harmonics.MAX_BANDS * WIDTH, types.float32)


@kernel
def project(start, stop, view, splats, table, depths, counts):
    """Fill the rows start..stop of the table, the depths and the numbers of tiles touched; 0 tiles: not drawn."""
    covariances, sh = len(splats.covariances) > 0, pointer(splats.sh)
    sources, rows, stride = pointers(splats), pointer(table), 3 * splats.sh.shape[1]
    world, numbers, block, bands = new_world(), new_numbers(), new_block(), new_bands()
    for first in range(start, stop, WIDTH):
        size = min(WIDTH, stop - first)
        for lane in range(size):
            counts[first + lane] = 0
            fetch(first + lane, lane, sources, covariances, world)
        p = plus(apply(view.rotation, get_vector(world, MEAN)), view.translation)
        axes = ellipses.lens(view, p)
        flat = flatten_matrix(axes, world) if covariances else flatten(axes, world)
        drawn = both(p[2] > view.near, fill_shape(view, p, flat, get(world, OPACITY), block))
        put(numbers, 0, sqrt(dot(p, p)) if view.radial else p[2])
        put(numbers, 1, count_tiles(block, drawn, view.width, view.height))
        shown = bits(get(numbers, 1) > 0) & ((1 << size) - 1)
        if shown != 0:
            harmonics.basis(narrowed(sight(view, get_vector(world, MEAN))[0]), view.sh_degree, bands)
        while shown != 0:
            lane = lowest(shown)
            shown &= shown - 1
            i = first + lane
            if fill_color(i * stride, lane, view, sh, bands, block):
                depths[i], counts[i] = numbers[lane], int(numbers[WIDTH + lane])
                for k in range(col.COLUMNS):
                    rows[i * col.COLUMNS + k] = block[k * WIDTH + lane]


@inner
def pointers(splats):
    """Where the tensors of splats begin, but for the coefficients."""
    return pointer(splats.means), pointer(splats.opacities), pointer(splats.quats), pointer(splats.scales), pointer(splats.covariances)


@inner
def fetch(i, lane, sources, has_covariances, world):
    """Write what is known of splat i into a lane of the block."""
    means, opacities, quats, scales, covariances = sources
    for k in range(3):
        world[(MEAN + k) * WIDTH + lane] = means[3 * i + k]
    world[OPACITY * WIDTH + lane] = opacities[i]
    if has_covariances:
        for k in range(9):
            world[(COVARIANCE + k) * WIDTH + lane] = covariances[9 * i + k]
    else:
        for k in range(4):
            world[(QUAT + k) * WIDTH + lane] = quats[4 * i + k]
        for k in range(3):
            world[(SCALE + k) * WIDTH + lane] = scales[3 * i + k]


@inner
def quaternion(world):
    return get(world, QUAT), get(world, QUAT + 1), get(world, QUAT + 2), get(world, QUAT + 3)


@inner
def matrix(world):
    return get_vector(world, COVARIANCE), get_vector(world, COVARIANCE + 3), get_vector(world, COVARIANCE + 6)


@inner
def flatten(axes, world):
    return ellipses.flatten(axes, ellipses.rotation(quaternion(world)), get_vector(world, SCALE))


@inner
def flatten_matrix(axes, world):
    return ellipses.flatten_matrix(axes, matrix(world))


@inner
def fill_shape(view, p, flat, opacity, block):
    """Write what the splats' ellipses are on the image, and tell which there are to draw."""
    per_z = 1 / p[2]
    x, y = view.fx * p[0] * per_z + view.cx, view.fy * p[1] * per_z + view.cy
    dilated, light = ellipses.screen_filter(view, flat)
    if view.seen == SEEN_AT_CENTER:
        return fill_point(view, x, y, dilated, opacity, light, block)
    along = integrals.axes(dilated)
    if view.seen == SEEN_IN_PIXEL:
        mass, bound, corner = integrals.mass(along, opacity), integrals.BRIGHTER * opacity, integrals.CORNER
        drawn = integrals.brightest(along, opacity) >= MIN_ALPHA
    else:
        mass, bound, corner = opacity, opacity, windows.CORNER
        drawn = both(opacity >= MIN_ALPHA, along[3] * FAR > 1)
    wider, bound = integrals.around(dilated, along, bound, corner)
    drawn = both(drawn, fill_ellipse(x, y, wider, bound, block))
    integrals.fill(along, mass, block)
    return drawn


@inner
def fill_point(view, x, y, shape, opacity, light, block):
    """`fill_shape` of splats that are seen at the centers of pixels."""
    shown = opacity * light
    aside = maximum(abs_of(x * (2 / view.width) - 1), abs_of(y * (2 / view.height) - 1))
    drawn = both(shown >= view.min_alpha, aside <= view.frame)
    put(block, col.GATE, spread(1))
    if view.culls:
        there = culling.is_drawn(view, shape, opacity)
        put(block, col.GATE, narrow(select(there, 1.0, opacity * 0)))
        drawn = drawn if view.felt else both(drawn, there)
        if view.least_spread > 0:
            shape, _ = culling.stretched(view, shape, there)
    if view.max_variance < math.inf:
        shape = culling.limited(view, shape)
    # alpha = whole·(w - faded), which ends where it is `end`
    whole = shown * (1 / (1 - view.faded))
    floor, end = whole * view.faded, maximum(shown * view.cut, view.min_alpha)
    gain = (end + floor) / MIN_ALPHA
    put(block, col.GAIN, narrow(gain))
    put(block, col.FLOOR, narrow(floor))
    return both(drawn, fill_ellipse(x, y, shape, whole / gain, block))


@inner
def abs_of(lanes):
    return maximum(lanes, 0 - lanes)


@inner
def fill_ellipse(x, y, shape, opacity, block):
    """Write the ellipses alpha >= 1/255 of shapes, and tell which are finite and bright enough."""
    xx, xy, yy, det = shape
    small = both(both(maximum(x, -x) < FAR, maximum(y, -y) < FAR), both(both(xx < FAR, yy < FAR), opacity < FAR))
    sharp = both(yy * FAR > 1, det * FAR > yy)
    drawn = both(both(small, sharp), opacity >= MIN_ALPHA)  # NaN passes no comparison
    peak = log2(opacity)
    reach = 2 * math.log(2) * (peak - math.log2(MIN_ALPHA))
    per_yy = 1 / yy
    across = det * per_yy
    put(block, col.X, narrow(x))
    put(block, col.Y, narrow(y))
    put(block, col.SHEAR, narrow(xy * per_yy))
    put(block, col.FALL_Y, narrow(HALF_LOG2E * per_yy))
    put(block, col.FALL_X, HALF_LOG2E / narrow(across))
    put(block, col.PEAK, narrow(peak))
    put(block, col.SPREAD, narrow(across * (1 / HALF_LOG2E)))
    put(block, col.REACH_Y, sqrt(narrow(reach * yy)))
    put(block, col.TIP, narrow(xy) * sqrt(narrow(reach) / narrow(xx)))
    return drawn


@inner
def fill_color(at, lane, view, sh, bands, block):
    """Write a splat's color in this view's direction into its lane; False where it is not finite. Its coefficients begin at sh[at]."""
    half, most = np.float32(0.5), np.float32(view.max_color)
    red, green, blue = half, half, half
    for j in range((view.sh_degree + 1) ** 2):
        band = bands[j * WIDTH + lane]
        red += band * sh[at + 3 * j]
        green += band * sh[at + 3 * j + 1]
        blue += band * sh[at + 3 * j + 2]
    red_step, green_step, blue_step = view.color_steps
    block[col.RED * WIDTH + lane] = in_steps(min(max(red, 0), most), red_step, most)
    block[col.GREEN * WIDTH + lane] = in_steps(min(max(green, 0), most), green_step, most)
    block[col.BLUE * WIDTH + lane] = in_steps(min(max(blue, 0), most), blue_step, most)
    return abs(red) < FAR and abs(green) < FAR and abs(blue) < FAR


@inner
def in_steps(value, step, most):
    """The nearest multiple of a step; 0: the value as it is. Never quite 0 or `most` but for what is: there a channel's gradient ends."""
    if step == 0 or value <= 0 or value >= most:
        return value
    return np.float32(max(min(round(value / step) * step, most * BELOW), TINY))


@inner
def sight(view, mean):
    """The unit vectors from the eye to means, and the distances; (0, 0, 1) and 0 for a splat in the very eye."""
    ray = minus(mean, view.eye)
    length = sqrt(dot(ray, ray))
    away = length > 0
    x, y, z = times(1 / length, ray)
    return (select(away, x, 0.0), select(away, y, 0.0), select(away, z, 1.0)), length


@inner
def narrowed(v):
    return narrow(v[0]), narrow(v[1]), narrow(v[2])
