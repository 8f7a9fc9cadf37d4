"""The backward pass of `projection`: gradients of splats in the world from those of their tiles, 16 splats at a time."""

# numba redefines calls and operators.
# mypy: ignore-errors

import math

from numba import types

from mipmap_plugin.backends.cpu_kernels import culling, ellipses, inner, integrals, kernel, layout
from mipmap_plugin.backends.cpu_kernels.blocks import get, get_vector, put, put_vector
from mipmap_plugin.backends.cpu_kernels.colors_back import grad_colors, new_spaces
from mipmap_plugin.backends.cpu_kernels.columns import apart, load_four, load_three, store_rows, together
from mipmap_plugin.backends.cpu_kernels.lanes import PART, WIDTH, narrow, select, wide
from mipmap_plugin.backends.cpu_kernels.memory import beyond, load, load_whole, pointer, scratch, store
from mipmap_plugin.backends.cpu_kernels.projection import (
    COVARIANCE,
    MEAN,
    OPACITY,
    QUAT,
    SCALE,
    covariance_of,
    load_splat,
    load_splats,
    new_world,
    pointers,
    quaternion,
)
from mipmap_plugin.backends.cpu_kernels.tuples import apply, plus

new_sums, new_rows = scratch(layout.GRADS * WIDTH, types.float64), scratch(WIDTH, types.int64)


@kernel
def project_back(start, stop, flags, view, splats, table, firsts, tile_grads, grads):
    """Add a view's gradients to those of the splats start..stop, the first of which has row 0 of `grads`.

    Splat i's tiles have the rows firsts[i]..firsts[i + 1] of tile_grads.
    """
    covariances, integrated, reshaped, _, fourth, third = flags
    stride = 3 * splats.sh.shape[1]
    colors = pointer(splats.sh), pointer(grads.sh), pointer(table), stride, len(grads.sh) > 0, start
    arrays, targets, tile_rows = pointers(splats), pointers(grads), pointer(tile_grads)
    world, d_world, sums, rows, spaces, size = new_world(), new_world(), new_sums(), new_rows(), new_spaces(), 0
    for i in range(start, stop):
        if firsts[i] < firsts[i + 1]:
            sum_tiles(tile_rows, firsts[i], firsts[i + 1], size, sums)
            rows[size] = i
            size += 1
        if size == WIDTH or (i == stop - 1 and size > 0):
            in_a_row = covariances is None and size == WIDTH and rows[WIDTH - 1] - rows[0] == WIDTH - 1
            if in_a_row:
                load_splats(rows[0], arrays, world)
            else:
                for lane in range(size):
                    load_splat(rows[lane], lane, arrays, covariances, world)
            for part in range(0, size, PART):
                grad_splats(view, covariances, integrated, reshaped, beyond(world, part), beyond(sums, part), beyond(d_world, part))
            grad_colors(view, fourth, third, rows, size, world, sums, colors, spaces, d_world)
            if in_a_row:
                add_grads(rows[0] - start, d_world, targets)
            else:
                for lane in range(size):
                    store_grads(rows[lane] - start, lane, d_world, targets, covariances)
            size = 0


@inner
def sum_tiles(tile_rows, first, last, lane, sums):
    """Sum a splat's gradients over its tiles, always in the same order, whichever threads they came from."""
    for k in range(layout.GRADS):
        sums[k * WIDTH + lane] = tile_rows[first * layout.GRADS + k]
    for slot in range(first + 1, last):
        for k in range(layout.GRADS):
            sums[k * WIDTH + lane] += tile_rows[slot * layout.GRADS + k]


@inner
def add_grads(first, d_world, targets):
    """Add the block `d_world` to 16 rows of the gradients, to the same bits as `store_grads`."""
    d_means, d_opacities, d_quats, d_scales, _ = targets
    add_three(d_means, 3 * first, MEAN, d_world)
    store(d_opacities, first, added(load(d_opacities, first), OPACITY, d_world))
    add_four(d_quats, 4 * first, QUAT, d_world)
    add_three(d_scales, 3 * first, SCALE, d_world)


@inner
def add_three(array, at, field, d_world):
    """Add three fields of a block to the 16 rows that begin at array[at]."""
    x, y, z = apart(load_three(array, at))
    store_rows(array, at, together((added(x, field, d_world), added(y, field + 1, d_world), added(z, field + 2, d_world))))


@inner
def add_four(array, at, field, d_world):
    """As `add_three`, for four."""
    w, x, y, z = apart(load_four(array, at))
    w, x, y, z = added(w, field, d_world), added(x, field + 1, d_world), added(y, field + 2, d_world), added(z, field + 3, d_world)
    store_rows(array, at, together((w, x, y, z)))


@inner
def added(lanes, field, d_world):
    """float32 lanes plus a field of a block, rounded once."""
    return narrow(wide(lanes) + load_whole(d_world, field * WIDTH))


@inner
def store_grads(i, lane, d_world, targets, has_covariances):
    """Add a lane of the block `d_world` to row i of the gradients."""
    d_means, d_opacities, d_quats, d_scales, d_covariances = targets
    for k in range(3):
        d_means[3 * i + k] += d_world[(MEAN + k) * WIDTH + lane]
    d_opacities[i] += d_world[OPACITY * WIDTH + lane]
    if has_covariances is not None:
        for k in range(9):
            d_covariances[9 * i + k] += d_world[(COVARIANCE + k) * WIDTH + lane]
    else:
        for k in range(4):
            d_quats[4 * i + k] += d_world[(QUAT + k) * WIDTH + lane]
        for k in range(3):
            d_scales[3 * i + k] += d_world[(SCALE + k) * WIDTH + lane]


@inner
def grad_splats(view, has_covariances, integrated, reshaped, world, sums, d_world):
    """Write the gradients of means, shapes and opacities of a part of the splats, without the means' gradient through the color."""
    p = plus(apply(view.rotation, get_vector(world, MEAN)), view.translation)
    jac, opacity = ellipses.jacobian(view, p), get(world, OPACITY)
    if has_covariances is not None:
        covariance = covariance_of(world)
        d_shape, d_opacity, d_x, d_y = grad_shape(view, integrated, reshaped, ellipses.project_covariance(jac, covariance), opacity, sums)
        d_jac, d_covariance = ellipses.grad_project_covariance(jac, covariance, d_shape)
        for k in range(3):
            put_vector(d_world, COVARIANCE + 3 * k, d_covariance[k])
    else:
        quat, scale = quaternion(world), get_vector(world, SCALE)
        axes = ellipses.rotation(quat)
        d_shape, d_opacity, d_x, d_y = grad_shape(view, integrated, reshaped, ellipses.project_axes(jac, axes, scale), opacity, sums)
        d_jac, d_axes, d_scale = ellipses.grad_project_axes(jac, axes, scale, d_shape)
        put_vector(d_world, SCALE, d_scale)
        d_quat = ellipses.grad_rotation(quat, d_axes)
        put_vector(d_world, QUAT, (d_quat[0], d_quat[1], d_quat[2]))
        put(d_world, QUAT + 3, d_quat[3])
    put(d_world, OPACITY, d_opacity)
    put_vector(d_world, MEAN, ellipses.grad_mean(view, p, jac, d_jac, d_x, d_y))


@inner
def grad_shape(view, integrated, reshaped, shape, opacity, sums):
    """The gradients of shapes before the screen filter, of opacities, and of positions on the image."""
    dilated, compensation = ellipses.screen_filter(view, shape)
    if integrated is not None:
        return grad_integral(view, shape, dilated, opacity, sums)
    if reshaped is not None and view.culls:
        return grad_culled(view, shape, dilated, compensation, opacity, sums)
    d_dilated, d_x, d_y = grad_ellipse(dilated, sums) if reshaped is None else grad_limited(view, dilated, sums)
    d_log_alpha = get(sums, layout.SUM)
    d_shape = ellipses.grad_screen_filter(view, shape, dilated, compensation, d_dilated, d_log_alpha / compensation)
    return d_shape, d_log_alpha / opacity, d_x, d_y


@inner
def grad_culled(view, shape, dilated, compensation, opacity, sums):
    """`grad_shape` where splats are culled or stretched."""
    d_gate, drawn = get(sums, layout.SUM), culling.is_drawn(view, dilated, opacity)
    d_log_alpha = select(drawn, d_gate, 0.0)
    if view.least_spread > 0:
        drawn_shape, changed = culling.stretched(view, dilated, drawn)
        d_drawn_shape, d_x, d_y = grad_limited(view, drawn_shape, sums)
        d_dilated = culling.grad_stretched(view, dilated, changed, d_drawn_shape)
    else:
        d_dilated, d_x, d_y = grad_limited(view, dilated, sums)
    d_gated, d_opacity = culling.grad_gate(view, dilated, opacity, d_gate)
    d_dilated = d_dilated[0] + d_gated[0], d_dilated[1] + d_gated[1], d_dilated[2] + d_gated[2], d_dilated[3] + d_gated[3]
    d_shape = ellipses.grad_screen_filter(view, shape, dilated, compensation, d_dilated, d_log_alpha / compensation)
    return d_shape, d_log_alpha / opacity + d_opacity, d_x, d_y


@inner
def grad_limited(view, shape, sums):
    """The gradients of ellipses before `culling.limited`, and of their positions on the image."""
    if view.max_variance == math.inf:
        return grad_ellipse(shape, sums)
    d_limited, d_x, d_y = grad_ellipse(culling.limited(view, shape), sums)
    return culling.grad_limited(view, shape, d_limited), d_x, d_y


@inner
def grad_ellipse(shape, sums):
    """The gradients of ellipses and of their positions on the image."""
    _, xy, yy, det = shape
    per_yy, per_det = 1 / yy, 1 / det
    shear, per_across = xy * per_yy, yy * per_det

    d_x = per_across * get(sums, layout.SUM_U)
    d_y = per_yy * get(sums, layout.SUM_Y) - shear * d_x
    d_shear = per_across * get(sums, layout.SUM_UY)
    d_per_yy, d_per_across = -0.5 * get(sums, layout.SUM_YY), -0.5 * get(sums, layout.SUM_UU)

    d_yy = d_per_across * per_det - per_yy * (d_per_yy * per_yy + d_shear * shear)
    return (d_yy * 0, d_shear * per_yy, d_yy, -d_per_across * per_across * per_det), d_x, d_y


@inner
def grad_integral(view, shape, dilated, opacity, sums):
    """`grad_shape` for splats that are integrated over pixels or windows."""
    cos, sin, long, short = integrals.axes(dilated)
    d_dilated = integrals.grad_axes(dilated, get(sums, layout.GRAD_LOG_LONG), get(sums, layout.GRAD_LOG_SHORT), get(sums, layout.GRAD_ANGLE))
    d_shape = ellipses.grad_screen_filter(view, shape, dilated, opacity * 0 + 1, d_dilated, opacity * 0)
    d_u, d_v = get(sums, layout.GRAD_U) / long, get(sums, layout.GRAD_V) / short
    return d_shape, get(sums, layout.SUM) / opacity, sin * d_v - cos * d_u, -sin * d_u - cos * d_v
