"""The way back of `projection`: gradients of splats in the world from what their tiles pull, 16 at a time."""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

import math

import numpy as np
from numba import types

from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels import culling, ellipses, harmonics, inner, integrals, kernel
from mipmap_plugin.backends.cpu_kernels.blocks import get, get_vector, put, put_vector
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, select, wide
from mipmap_plugin.backends.cpu_kernels.memory import pointer, scratch
from mipmap_plugin.backends.cpu_kernels.projection import (
    COVARIANCE,
    MEAN,
    OPACITY,
    QUAT,
    SCALE,
    fetch,
    matrix,
    narrowed,
    new_bands,
    new_world,
    pointers,
    quaternion,
    sight,
)
from mipmap_plugin.backends.cpu_kernels.records import SEEN_AT_CENTER
from mipmap_plugin.backends.cpu_kernels.tuples import apply, blend, dot, plus

new_pull, new_rows = scratch(col.PULLS * WIDTH, types.float64), scratch(WIDTH, types.int64)


@kernel
def project_back(start, stop, view, splats, table, slots, pulls, grads):
    """Gradients of the splats start..stop from the pulls of their tiles, rows slots[i]..slots[i + 1]."""
    covariances, stride = len(splats.covariances) > 0, 3 * splats.sh.shape[1]
    colors = pointer(splats.sh), pointer(grads.sh), pointer(table), stride, len(grads.sh) > 0
    sources, targets, tiles = pointers(splats), pointers(grads), pointer(pulls)
    world, d_world, pull, bands, along, rows, size = new_world(), new_world(), new_pull(), new_bands(), new_bands(), new_rows(), 0
    for i in range(start, stop):
        if slots[i] < slots[i + 1]:
            add_up(tiles, slots[i], slots[i + 1], size, pull)
            fetch(i, size, sources, covariances, world)
            rows[size] = i
            size += 1
        else:
            clear(i, targets, covariances, colors)
        if size == WIDTH or (i == stop - 1 and size > 0):
            pull_splats(view, covariances, world, pull, d_world)
            pull_colors(view, rows, size, world, pull, colors, bands, along, d_world)
            for lane in range(size):
                deliver(rows[lane], lane, d_world, targets, covariances)
            size = 0


@inner
def clear(i, targets, has_covariances, colors):
    d_means, d_opacities, d_quats, d_scales, d_covariances = targets
    _, d_sh, _, stride, wanted = colors
    fill(d_means, 3 * i, 3)
    fill(d_opacities, i, 1)
    if wanted:
        fill(d_sh, stride * i, stride)
    if has_covariances:
        fill(d_covariances, 9 * i, 9)
    else:
        fill(d_scales, 3 * i, 3)
        fill(d_quats, 4 * i, 4)


@inner
def fill(target, first, count):
    """Zeros."""
    for at in range(first, first + count):
        target[at] = 0


@inner
def add_up(tiles, first, last, lane, pull):
    """Sum a splat's pulls, always tile after tile, whatever threads they came from."""
    for k in range(col.PULLS):
        pull[k * WIDTH + lane] = tiles[first * col.PULLS + k]
    for slot in range(first + 1, last):
        for k in range(col.PULLS):
            pull[k * WIDTH + lane] += tiles[slot * col.PULLS + k]


@inner
def deliver(i, lane, d_world, targets, has_covariances):
    """Write a lane of the block into the gradients of splat i."""
    d_means, d_opacities, d_quats, d_scales, d_covariances = targets
    for k in range(3):
        d_means[3 * i + k] = d_world[(MEAN + k) * WIDTH + lane]
    d_opacities[i] = d_world[OPACITY * WIDTH + lane]
    if has_covariances:
        for k in range(9):
            d_covariances[9 * i + k] = d_world[(COVARIANCE + k) * WIDTH + lane]
    else:
        for k in range(4):
            d_quats[4 * i + k] = d_world[(QUAT + k) * WIDTH + lane]
        for k in range(3):
            d_scales[3 * i + k] = d_world[(SCALE + k) * WIDTH + lane]


@inner
def pull_splats(view, has_covariances, world, pull, d_world):
    """Gradients of means, shapes and opacities, without what the means owe to the color."""
    p = plus(apply(view.rotation, get_vector(world, MEAN)), view.translation)
    axes, opacity = ellipses.lens(view, p), get(world, OPACITY)
    if has_covariances:
        covariance = matrix(world)
        d_flat, d_opacity, d_x, d_y = pull_shape(view, ellipses.flatten_matrix(axes, covariance), opacity, pull)
        d_axes, d_covariance = ellipses.pull_flatten_matrix(axes, covariance, d_flat)
        for k in range(3):
            put_vector(d_world, COVARIANCE + 3 * k, d_covariance[k])
    else:
        quat, scale = quaternion(world), get_vector(world, SCALE)
        turn = ellipses.rotation(quat)
        d_flat, d_opacity, d_x, d_y = pull_shape(view, ellipses.flatten(axes, turn, scale), opacity, pull)
        d_axes, d_turn, d_scale = ellipses.pull_flatten(axes, turn, scale, d_flat)
        put_vector(d_world, SCALE, d_scale)
        d_quat = ellipses.pull_rotation(quat, d_turn)
        put_vector(d_world, QUAT, (d_quat[0], d_quat[1], d_quat[2]))
        put(d_world, QUAT + 3, d_quat[3])
    put(d_world, OPACITY, d_opacity)
    put_vector(d_world, MEAN, ellipses.pull_point(view, p, axes, d_axes, d_x, d_y))


@inner
def pull_shape(view, flat, opacity, pull):
    """Gradients of the shapes before the screen filter, of the opacities, and of the places on the image."""
    dilated, light = ellipses.screen_filter(view, flat)
    if view.seen != SEEN_AT_CENTER:
        return pull_integral(view, flat, dilated, opacity, pull)
    if view.culls:
        return pull_culled(view, flat, dilated, light, opacity, pull)
    d_dilated, d_x, d_y = pull_limited(view, dilated, pull)
    light_pull = get(pull, col.SUM)
    d_flat = ellipses.pull_screen_filter(view, flat, dilated, light, d_dilated, light_pull / light)
    return d_flat, light_pull / opacity, d_x, d_y


@inner
def pull_culled(view, flat, dilated, light, opacity, pull):
    """`pull_shape` where splats are culled or stretched."""
    gate_pull, drawn = get(pull, col.SUM), culling.is_drawn(view, dilated, opacity)
    light_pull = select(drawn, gate_pull, 0.0)
    if view.least_spread > 0:
        shape, changed = culling.stretched(view, dilated, drawn)
        d_shape, d_x, d_y = pull_limited(view, shape, pull)
        d_dilated = culling.pull_stretched(view, dilated, changed, d_shape)
    else:
        d_dilated, d_x, d_y = pull_limited(view, dilated, pull)
    d_gated, d_opacity = culling.pull_gate(view, dilated, opacity, gate_pull)
    d_dilated = d_dilated[0] + d_gated[0], d_dilated[1] + d_gated[1], d_dilated[2] + d_gated[2], d_dilated[3] + d_gated[3]
    d_flat = ellipses.pull_screen_filter(view, flat, dilated, light, d_dilated, light_pull / light)
    return d_flat, light_pull / opacity + d_opacity, d_x, d_y


@inner
def pull_limited(view, shape, pull):
    """Gradients of ellipses, before they are made smaller where they are too large, and of their places on the image."""
    if view.max_variance == math.inf:
        return pull_ellipse(shape, pull)
    d_limited, d_x, d_y = pull_ellipse(culling.limited(view, shape), pull)
    return culling.pull_limited(view, shape, d_limited), d_x, d_y


@inner
def pull_ellipse(shape, pull):
    """Gradients of ellipses and of their places on the image."""
    _, xy, yy, det = shape
    per_yy, per_det = 1 / yy, 1 / det
    shear, per_across = xy * per_yy, yy * per_det

    d_x = per_across * get(pull, col.SUM_U)
    d_y = per_yy * get(pull, col.SUM_Y) - shear * d_x
    d_shear = per_across * get(pull, col.SUM_UY)
    d_per_yy, d_per_across = -0.5 * get(pull, col.SUM_YY), -0.5 * get(pull, col.SUM_UU)

    d_yy = d_per_across * per_det - per_yy * (d_per_yy * per_yy + d_shear * shear)
    return (d_yy * 0, d_shear * per_yy, d_yy, -d_per_across * per_across * per_det), d_x, d_y


@inner
def pull_integral(view, flat, dilated, opacity, pull):
    """As `pull_shape`, of splats that are integrated over pixels or windows."""
    cos, sin, long, short = integrals.axes(dilated)
    d_dilated = integrals.pull_axes(dilated, get(pull, col.GROW_LONG), get(pull, col.GROW_SHORT), get(pull, col.TURN))
    d_flat = ellipses.pull_screen_filter(view, flat, dilated, opacity * 0 + 1, d_dilated, opacity * 0)
    d_u, d_v = get(pull, col.BY_LONG) / long, get(pull, col.BY_SHORT) / short
    return d_flat, get(pull, col.SUM) / opacity, sin * d_v - cos * d_u, -sin * d_u - cos * d_v


@inner
def pull_colors(view, rows, size, world, pull, colors, bands, along, d_world):
    """Gradients through the color: writes those of the coefficients where they are wanted, adds to those of the means."""
    direction, length = sight(view, get_vector(world, MEAN))
    harmonics.basis(narrowed(direction), view.sh_degree, bands)
    for lane in range(size):
        pull_color(rows[lane], lane, view, colors, pull, bands, along)
    if view.sh_degree > 0:
        d_x, d_y, d_z = harmonics.slope(narrowed(direction), view.sh_degree, along)
        d_direction = wide(d_x), wide(d_y), wide(d_z)
        per_length = select(length > 0, 1 / length, 0.0)
        d_mean = blend(per_length, d_direction, -dot(d_direction, direction) * per_length, direction)
        put_vector(d_world, MEAN, plus(get_vector(d_world, MEAN), d_mean))


@inner
def pull_color(i, lane, view, colors, pull, bands, along):
    """The gradients of splat i's coefficients, and into its lane those of its bands."""
    sh, d_sh, table, stride, wanted = colors
    at, row, zero, most = i * stride, i * col.COLUMNS, np.float32(0), np.float32(view.max_color)
    # A channel that was cut off at black, or at the largest color, has no gradient.
    d_red = np.float32(pull[col.PULL_RED * WIDTH + lane]) if 0 < table[row + col.RED] < most else zero
    d_green = np.float32(pull[col.PULL_GREEN * WIDTH + lane]) if 0 < table[row + col.GREEN] < most else zero
    d_blue = np.float32(pull[col.PULL_BLUE * WIDTH + lane]) if 0 < table[row + col.BLUE] < most else zero
    used = (view.sh_degree + 1) ** 2
    for j in range(used):
        along[j * WIDTH + lane] = d_red * sh[at + 3 * j] + d_green * sh[at + 3 * j + 1] + d_blue * sh[at + 3 * j + 2]
    if wanted:
        for j in range(used):
            band = bands[j * WIDTH + lane]
            d_sh[at + 3 * j], d_sh[at + 3 * j + 1], d_sh[at + 3 * j + 2] = d_red * band, d_green * band, d_blue * band
        fill(d_sh, at + 3 * used, stride - 3 * used)
