"""Splats in the world to rows of the splat table, 16 at a time. Geometry is in float64: float32 would lose needles and distant splats."""

# numba redefines calls and operators.
# mypy: ignore-errors

import math

import numpy as np
from numba import types

from mipmap_plugin.backends.cpu_kernels import culling, ellipses, harmonics, inner, integrals, kernel, layout, windows
from mipmap_plugin.backends.cpu_kernels.binning import count_tiles
from mipmap_plugin.backends.cpu_kernels.blocks import get, get_vector, put
from mipmap_plugin.backends.cpu_kernels.columns import apart, load_three, transpose
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, bits, both, broadcast, lowest_bit, maximum, narrow, select, sqrt, total, wide
from mipmap_plugin.backends.cpu_kernels.memory import load, pointer, scratch, store
from mipmap_plugin.backends.cpu_kernels.powers import log2
from mipmap_plugin.backends.cpu_kernels.records import OVER_PIXEL
from mipmap_plugin.backends.cpu_kernels.tuples import apply, dot, minus, plus, times
from mipmap_plugin.effects import MIN_ALPHA

# -q/2 = -HALF_LOG2E · q in powers of two.
HALF_LOG2E = 0.5 / math.log(2)

# Sizes (px, px²), opacities and colors beyond this count as infinite: their squares would overflow float32.
HUGE = 1e30

# The least positive color, and the factor that makes the largest color slightly less, in float32.
MIN_COLOR, BELOW_MAX = 1e-30, 1 - 1e-7

# Fields of a block of splats in the world, float64, as in `SplatArrays`. A shape is either a covariance or a quaternion and scales.
MEAN, OPACITY, COVARIANCE, QUAT, SCALE = 0, 3, 4, 4, 8
WORLD_FIELDS = 13

new_world, new_sizes = scratch(WORLD_FIELDS * WIDTH, types.float64), scratch(2 * WIDTH, types.float64)
new_block, new_bands = scratch(layout.SPLAT_FIELDS * WIDTH, types.float32), scratch(harmonics.MAX_BANDS * WIDTH, types.float32)


@kernel
def project(start, stop, flags, view, splats, table, depths, counts):
    """Fill the rows start..stop of the table, of the depths and of the numbers of tiles touched; 0 tiles: not drawn. flags: see `Flags`."""
    covariances, integrated, reshaped, _, fourth, third = flags
    sh = pointer(splats.sh)
    arrays, rows, stride = pointers(splats), pointer(table), 3 * splats.sh.shape[1]
    world, sizes, block, row_of, bands, bands_of = new_world(), new_sizes(), new_block(), new_block(), new_bands(), new_bands()
    for first in range(start, stop, WIDTH):
        size = min(WIDTH, stop - first)
        for lane in range(size):
            counts[first + lane] = 0
        if size == WIDTH and covariances is None:
            load_splats(first, arrays, world)
        else:
            for lane in range(size):
                load_splat(first + lane, lane, arrays, covariances, world)
        p = plus(apply(view.rotation, get_vector(world, MEAN)), view.translation)
        jac = ellipses.jacobian(view, p)
        shape = project_any(jac, covariances, world)
        drawn = both(p[2] > view.near_plane, fill_shape(view, integrated, reshaped, p, shape, get(world, OPACITY), block))
        put(sizes, 0, sqrt(dot(p, p)) if view.radial else p[2])
        put(sizes, 1, count_tiles(block, drawn, view.width, view.height))
        visible = bits(get(sizes, 1) > 0) & ((1 << size) - 1)
        if visible != 0:
            harmonics.basis(narrowed(view_direction(view, get_vector(world, MEAN))[0]), view.sh_degree, fourth, bands)
            transpose(block, row_of)
            if third is not None:
                transpose(bands, bands_of)
        while visible != 0:
            lane = lowest_bit(visible)
            visible &= visible - 1
            i = first + lane
            if fill_color(color_of(i * stride, lane, view, third, sh, bands, bands_of), lane * layout.SPLAT_FIELDS, view, row_of):
                depths[i], counts[i] = sizes[lane], int(sizes[WIDTH + lane])
                store(rows, i * layout.SPLAT_FIELDS, load(row_of, lane * layout.SPLAT_FIELDS))


@inner
def pointers(splats):
    """Pointers to the arrays of splats, without the coefficients."""
    return pointer(splats.means), pointer(splats.opacities), pointer(splats.quats), pointer(splats.scales), pointer(splats.covariances)


@inner
def load_splats(first, arrays, world):
    """Load 16 splats in a row, which have no covariances."""
    means, opacities, quats, scales, _ = arrays
    put_wide(world, MEAN, apart(load_three(means, 3 * first)))
    put(world, OPACITY, wide(load(opacities, first)))
    at = 4 * first
    put_wide(world, QUAT, apart((load(quats, at), load(quats, at + WIDTH), load(quats, at + 2 * WIDTH), load(quats, at + 3 * WIDTH))))
    put_wide(world, SCALE, apart(load_three(scales, 3 * first)))


@inner
def put_wide(world, field, columns):
    """Write consecutive fields, as float64."""
    for k in range(len(columns)):
        put(world, field + k, wide(columns[k]))


@inner
def load_splat(i, lane, arrays, has_covariances, world):
    """Load splat i into a lane of the block `world`."""
    means, opacities, quats, scales, covariances = arrays
    for k in range(3):
        world[(MEAN + k) * WIDTH + lane] = means[3 * i + k]
    world[OPACITY * WIDTH + lane] = opacities[i]
    if has_covariances is not None:
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
def covariance_of(world):
    return get_vector(world, COVARIANCE), get_vector(world, COVARIANCE + 3), get_vector(world, COVARIANCE + 6)


@inner
def project_any(jac, has_covariances, world):
    """The shapes of a block's splats on the image."""
    if has_covariances is not None:
        return ellipses.project_covariance(jac, covariance_of(world))
    return ellipses.project_axes(jac, ellipses.rotation(quaternion(world)), get_vector(world, SCALE))


@inner
def fill_shape(view, integrated, reshaped, p, shape, opacity, block):
    """Write the splats' ellipses on the image; returns which splats are drawn."""
    per_z = 1 / p[2]
    x, y = view.fx * p[0] * per_z + view.cx, view.fy * p[1] * per_z + view.cy
    dilated, compensation = ellipses.screen_filter(view, shape)
    if integrated is None:
        return fill_at_center(view, reshaped, x, y, dilated, opacity, compensation, block)
    return fill_integral(view, x, y, dilated, opacity, block)


@inner
def fill_integral(view, x, y, dilated, opacity, block):
    """`fill_shape` for splats that are integrated over pixels or windows."""
    splat_axes = integrals.axes(dilated)
    if view.sampling == OVER_PIXEL:
        mass, bound, corner = integrals.mass(splat_axes, opacity), integrals.BOUND_SQUARED * opacity, integrals.CORNER
        drawn = integrals.peak_alpha(splat_axes, opacity) >= MIN_ALPHA
    else:
        mass, bound, corner = opacity, opacity, windows.CORNER
        drawn = both(opacity >= MIN_ALPHA, splat_axes[3] * HUGE > 1)
    bounds, bound = integrals.bounding_ellipse(dilated, splat_axes, bound, corner)
    drawn = both(drawn, fill_ellipse(x, y, bounds, bound, block))
    integrals.put_integral(splat_axes, mass, block)
    return drawn


@inner
def fill_at_center(view, reshaped, x, y, shape, opacity, compensation, block):
    """`fill_shape` for splats that are sampled at pixel centers."""
    compensated = opacity * compensation
    offset_from_middle = maximum(absolute(x * (2 / view.width) - 1), absolute(y * (2 / view.height) - 1))
    drawn = both(compensated >= view.min_alpha, offset_from_middle <= view.max_offset)
    put(block, layout.GATE, broadcast(1))
    if reshaped is not None:
        drawn, shape = reshape(view, drawn, shape, opacity, block)
    # alpha = peak·(w - w_end), down to `last_alpha`
    peak = compensated * (1 / (1 - view.w_end))
    offset, last_alpha = peak * view.w_end, maximum(compensated * view.w_cut, view.min_alpha)
    gain = (last_alpha + offset) / MIN_ALPHA
    put(block, layout.GAIN, narrow(gain))
    put(block, layout.OFFSET, narrow(offset))
    return both(drawn, fill_ellipse(x, y, shape, peak / gain, block))


@inner
def reshape(view, drawn, shape, opacity, block):
    """Cull, stretch and shrink as the view asks for it; returns which splats are drawn, and their shapes."""
    if view.culls:
        kept = culling.is_drawn(view, shape, opacity)
        put(block, layout.GATE, narrow(select(kept, 1.0, opacity * 0)))
        drawn = drawn if view.lists_culled else both(drawn, kept)
        if view.least_spread > 0:
            shape, _ = culling.stretched(view, shape, kept)
    if view.max_variance < math.inf:
        shape = culling.limited(view, shape)
    return drawn, shape


@inner
def absolute(lanes):
    return maximum(lanes, 0 - lanes)


@inner
def fill_ellipse(x, y, shape, opacity, block):
    """Write the ellipses alpha >= 1/255 of shapes; returns which are finite and bright enough."""
    xx, xy, yy, det = shape
    bounded = both(both(maximum(x, -x) < HUGE, maximum(y, -y) < HUGE), both(both(xx < HUGE, yy < HUGE), opacity < HUGE))
    not_thin = both(yy * HUGE > 1, det * HUGE > yy)
    drawn = both(both(bounded, not_thin), opacity >= MIN_ALPHA)  # NaN passes no comparison
    peak = log2(opacity)
    reach = 2 * math.log(2) * (peak - math.log2(MIN_ALPHA))
    per_yy = 1 / yy
    across = det * per_yy
    put(block, layout.X, narrow(x))
    put(block, layout.Y, narrow(y))
    put(block, layout.SHEAR, narrow(xy * per_yy))
    put(block, layout.FALL_Y, narrow(HALF_LOG2E * per_yy))
    put(block, layout.FALL_X, HALF_LOG2E / narrow(across))
    put(block, layout.PEAK, narrow(peak))
    put(block, layout.PER_FALL_X, narrow(across * (1 / HALF_LOG2E)))
    put(block, layout.REACH_Y, sqrt(narrow(reach * yy)))
    put(block, layout.RIGHTMOST_DY, narrow(xy) * sqrt(narrow(reach) / narrow(xx)))
    return drawn


@inner
def color_of(at, lane, view, third, sh, bands, bands_of):
    """The color of the splat in a lane, in this view's direction. Its coefficients start at sh[at]; `bands_of`, if `third`: bands lane by lane."""
    half = np.float32(0.5)
    red, green, blue = half, half, half
    if third is not None:
        band = load(bands_of, lane * WIDTH)
        reds, greens, blues = apart(load_three(sh, at))
        return half + total(band * reds), half + total(band * greens), half + total(band * blues)
    for j in range((view.sh_degree + 1) ** 2):
        band = bands[j * WIDTH + lane]
        red += band * sh[at + 3 * j]
        green += band * sh[at + 3 * j + 1]
        blue += band * sh[at + 3 * j + 2]
    return red, green, blue


@inner
def fill_color(color, at, view, row_of):
    """Write a splat's color to its row, which begins at row_of[at]; returns whether it is finite."""
    red, green, blue = color
    largest = np.float32(view.max_color)
    red_step, green_step, blue_step = view.color_steps
    row_of[at + layout.RED] = quantized(min(max(red, 0), largest), red_step, largest)
    row_of[at + layout.GREEN] = quantized(min(max(green, 0), largest), green_step, largest)
    row_of[at + layout.BLUE] = quantized(min(max(blue, 0), largest), blue_step, largest)
    return abs(red) < HUGE and abs(green) < HUGE and abs(blue) < HUGE


@inner
def quantized(value, step, largest):
    """The nearest multiple of `step`; step 0: unchanged. Other values never become 0 or `largest`, where a channel has no gradient."""
    if step == 0 or value <= 0 or value >= largest:
        return value
    return np.float32(max(min(round(value / step) * step, largest * BELOW_MAX), MIN_COLOR))


@inner
def view_direction(view, mean):
    """The unit vectors from the eye to means, and the distances; (0, 0, 1) and 0 for a splat at the eye."""
    ray = minus(mean, view.eye)
    length = sqrt(dot(ray, ray))
    apart = length > 0
    x, y, z = times(1 / length, ray)
    return (select(apart, x, 0.0), select(apart, y, 0.0), select(apart, z, 1.0)), length


@inner
def narrowed(v):
    return narrow(v[0]), narrow(v[1]), narrow(v[2])
