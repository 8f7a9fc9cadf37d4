"""Splats in the world to rows of the splat table, 16 at a time. Geometry is in float64: float32 would lose needles and distant splats.

It is computed part by part of the 16 (`lanes.PART`).
"""

# numba redefines calls and operators.
# mypy: ignore-errors

import math

from numba import types

from mipmap_plugin.backends.cpu_kernels import culling, ellipses, harmonics, inner, integrals, kernel, layout, windows
from mipmap_plugin.backends.cpu_kernels.binning import count_tiles
from mipmap_plugin.backends.cpu_kernels.blocks import get, get_vector, put, put_vector
from mipmap_plugin.backends.cpu_kernels.colors import clamp_colors, fill_colors
from mipmap_plugin.backends.cpu_kernels.columns import apart, load_four, load_three, transpose
from mipmap_plugin.backends.cpu_kernels.lanes import PART, WIDTH, absolute, bits, both, lowest_bit, maximum, narrow, select, sqrt, wide
from mipmap_plugin.backends.cpu_kernels.layout import HUGE
from mipmap_plugin.backends.cpu_kernels.memory import beyond, load, pointer, scratch, store, store_integers
from mipmap_plugin.backends.cpu_kernels.powers import HALF_LOG2E, log2
from mipmap_plugin.backends.cpu_kernels.records import OVER_PIXEL
from mipmap_plugin.backends.cpu_kernels.tuples import apply, dot, minus, plus, times
from mipmap_plugin.render_settings import MIN_ALPHA

# Fields of a block of splats in the world, float64, as in `SplatArrays`. A shape is either a covariance or a quaternion and scales.
MEAN, OPACITY, COVARIANCE, QUAT, SCALE = 0, 3, 4, 4, 8
WORLD_FIELDS = 13

# Fields of a block of what is found part by part, float32: what `store_places` writes, and unit vectors from the eye.
DEPTH, COUNT, FIRST_TILE, DIRECTION = 0, 1, 2, 3
SEEN_FIELDS = 6

new_world, new_seen = scratch(WORLD_FIELDS * WIDTH, types.float64), scratch(SEEN_FIELDS * WIDTH, types.float32)
new_block, new_bands = scratch(layout.SPLAT_FIELDS * WIDTH, types.float32), scratch(harmonics.MAX_BANDS * WIDTH, types.float32)


@kernel
def project(start, stop, flags, view, splats, table, depths, counts, first_tiles):
    """Fill the rows start..stop of the table, the depths, the numbers of tiles touched, 0 where not drawn, and the first of these tiles.

    flags: see `Flags`.
    """
    covariances, integrated, reshaped, _, fourth, third = flags
    arrays, sh, rows, stride = pointers(splats), pointer(splats.sh), pointer(table), 3 * splats.sh.shape[1]
    outputs = pointer(depths), pointer(counts), pointer(first_tiles)
    world, seen, block, row_of, bands, bands_of = new_world(), new_seen(), new_block(), new_block(), new_bands(), new_bands()
    for first in range(start, stop, WIDTH):
        size = min(WIDTH, stop - first)
        if size == WIDTH and covariances is None:
            load_splats(first, arrays, world)
        else:
            for lane in range(size):
                load_splat(first + lane, lane, arrays, covariances, world)
        visible = 0
        for part in range(0, size, PART):
            visible |= project_part(view, covariances, integrated, reshaped, beyond(world, part), beyond(block, part), beyond(seen, part)) << part
        visible &= (1 << size) - 1
        if visible != 0:
            harmonics.basis(get_vector(seen, DIRECTION), view.sh_degree, fourth, bands)
            if third is not None:
                transpose(bands, bands_of)
            fill_colors(visible, first * stride, stride, view, third, sh, bands, bands_of, block)
            finite = clamp_colors(view, block)
            put(seen, COUNT, select(finite, get(seen, COUNT), 0))
            transpose(block, row_of)
            store_rows_of(visible & bits(finite), first, row_of, rows)
        store_places(first, size, seen, outputs)


@inner
def project_part(view, covariances, integrated, reshaped, world, block, seen):
    """Fill a part of the blocks `block`, without colors, and `seen`; returns a bit for each splat that touches a tile."""
    mean = get_vector(world, MEAN)
    p = plus(apply(view.rotation, mean), view.translation)
    shape = project_any(ellipses.jacobian(view, p), covariances, world)
    drawn = both(p[2] > view.near_plane, fill_shape(view, integrated, reshaped, p, shape, get(world, OPACITY), block))
    count, first_tile = count_tiles(block, drawn, view.width, view.height)
    depth = sqrt(dot(p, p)) if view.radial else p[2]
    put_vector(seen, DEPTH, (narrow(depth), narrow(count), narrow(first_tile)))
    put_vector(seen, DIRECTION, narrowed(view_direction(view, mean)[0]))
    return bits(count > 0)


@inner
def store_rows_of(shown, first, row_of, rows):
    """Copy the rows of the splats whose bit is set; `first` is that of lane 0."""
    while shown != 0:
        lane = lowest_bit(shown)
        shown &= shown - 1
        store(rows, (first + lane) * layout.SPLAT_FIELDS, load(row_of, lane * layout.SPLAT_FIELDS))


@inner
def store_places(first, size, seen, outputs):
    """Write the depths, the numbers of tiles and the first tiles of `size` splats."""
    depths, counts, first_tiles = outputs
    if size == WIDTH:
        store(depths, first, get(seen, DEPTH))
        store_integers(counts, first, get(seen, COUNT))
        store_integers(first_tiles, first, get(seen, FIRST_TILE))
    else:
        for lane in range(size):
            depths[first + lane] = seen[DEPTH * WIDTH + lane]
            counts[first + lane], first_tiles[first + lane] = int(seen[COUNT * WIDTH + lane]), int(seen[FIRST_TILE * WIDTH + lane])


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
    put_wide(world, QUAT, apart(load_four(quats, 4 * first)))
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
    """The splats' shapes on the image."""
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
    put(block, layout.GATE, narrow(opacity * 0 + 1))
    if reshaped is not None:
        drawn, shape = reshape(view, drawn, shape, opacity, block)
    # alpha = peak·(w - w_end), down to `last_alpha`
    peak = compensated * (1 / (1 - view.w_end))
    offset, last_alpha = peak * view.w_end, maximum(compensated * view.w_cut, view.min_alpha)
    gain = (last_alpha + offset) * (1 / MIN_ALPHA)
    put(block, layout.GAIN, narrow(gain))
    put(block, layout.OFFSET, narrow(offset))
    if view.w_cut > 0 or view.w_end > 0 or view.min_alpha != MIN_ALPHA:  # otherwise the gain is 1
        peak = peak / gain
    return both(drawn, fill_ellipse(x, y, shape, peak, block))


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
