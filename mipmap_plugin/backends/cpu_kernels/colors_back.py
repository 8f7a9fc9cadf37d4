"""The backward pass of `colors`: gradients of harmonics' coefficients, and of means through the directions that they are seen in, 16 at a time."""

# numba redefines calls and operators.
# mypy: ignore-errors

import numpy as np
from numba import types

from mipmap_plugin.backends.cpu_kernels import harmonics, inner, layout
from mipmap_plugin.backends.cpu_kernels.blocks import get, get_part, get_vector, put, put_vector
from mipmap_plugin.backends.cpu_kernels.columns import apart, load_three, repeated, thrice, transpose
from mipmap_plugin.backends.cpu_kernels.lanes import PART, WIDTH, select, wide
from mipmap_plugin.backends.cpu_kernels.memory import beyond, load, scratch, store
from mipmap_plugin.backends.cpu_kernels.projection import MEAN, narrowed, new_bands, view_direction
from mipmap_plugin.backends.cpu_kernels.tuples import dot, plus, weighted_sum

# Fields of a block of float64: unit vectors from the eye, and 1 / the distance to it, 0 at the eye.
DIRECTION, PER_LENGTH = 0, 3
RAY_FIELDS = 4

new_rays, new_directions = scratch(RAY_FIELDS * WIDTH, types.float64), scratch(3 * WIDTH, types.float32)


@inner
def new_spaces():
    """Blocks that `grad_colors` uses."""
    return new_rays(), new_directions(), new_bands(), new_bands(), new_bands(), new_bands()


@inner
def grad_colors(view, fourth, third, rows, size, world, sums, colors, spaces, d_world):
    """The gradients through the color: add those of the coefficients if wanted, and those of the means in `d_world`. spaces: `new_spaces`."""
    rays, directions, bands, d_bands, bands_of, d_bands_of = spaces
    for part in range(0, size, PART):
        put_rays(view, beyond(world, part), beyond(rays, part), beyond(directions, part))
    harmonics.basis(get_vector(directions, 0), view.sh_degree, fourth, bands)
    if third is not None:
        transpose(bands, bands_of)
        for lane in range(size):
            grad_color_of_third(rows[lane], lane, view, colors, sums, bands_of, d_bands_of)
        transpose(d_bands_of, d_bands)
    else:
        for lane in range(size):
            grad_color(rows[lane], lane, view, colors, sums, bands, d_bands)
    if view.sh_degree > 0:
        put_vector(directions, 0, harmonics.grad_direction(get_vector(directions, 0), view.sh_degree, fourth, d_bands))
        for part in range(0, size, PART):
            add_mean(beyond(directions, part), beyond(rays, part), beyond(d_world, part))


@inner
def put_rays(view, world, rays, directions):
    """Write the unit vectors from the eye to a part of the splats, also as float32, and 1 / the distances."""
    direction, length = view_direction(view, get_vector(world, MEAN))
    put_vector(rays, DIRECTION, direction)
    put(rays, PER_LENGTH, select(length > 0, 1 / length, 0.0))
    put_vector(directions, 0, narrowed(direction))


@inner
def add_mean(d_directions, rays, d_world):
    """Add the gradients of the means of a part of the splats, through the directions from the eye, to `d_world`."""
    d_direction = wide(get_part(d_directions, 0)), wide(get_part(d_directions, 1)), wide(get_part(d_directions, 2))
    direction, per_length = get_vector(rays, DIRECTION), get(rays, PER_LENGTH)
    d_mean = weighted_sum(per_length, d_direction, -dot(d_direction, direction) * per_length, direction)
    put_vector(d_world, MEAN, plus(get_vector(d_world, MEAN), d_mean))


@inner
def grad_shown(i, lane, view, table, sums):
    """The gradient of splat i's color. A channel that was clamped to black or to the largest color has none."""
    row, zero, largest = i * layout.SPLAT_FIELDS, np.float32(0), np.float32(view.max_color)
    d_red = np.float32(sums[layout.GRAD_RED * WIDTH + lane]) if 0 < table[row + layout.RED] < largest else zero
    d_green = np.float32(sums[layout.GRAD_GREEN * WIDTH + lane]) if 0 < table[row + layout.GREEN] < largest else zero
    d_blue = np.float32(sums[layout.GRAD_BLUE * WIDTH + lane]) if 0 < table[row + layout.BLUE] < largest else zero
    return d_red, d_green, d_blue


@inner
def grad_color(i, lane, view, colors, sums, bands, d_bands):
    """The gradients of splat i's coefficients and, in its lane, of its spherical harmonics."""
    sh, d_sh, table, stride, wanted, start = colors
    at, used = i * stride, (view.sh_degree + 1) ** 2
    d_red, d_green, d_blue = grad_shown(i, lane, view, table, sums)
    for j in range(used):
        d_bands[j * WIDTH + lane] = d_red * sh[at + 3 * j] + d_green * sh[at + 3 * j + 1] + d_blue * sh[at + 3 * j + 2]
    if wanted:
        into = at - start * stride
        for j in range(used):
            band = bands[j * WIDTH + lane]
            d_sh[into + 3 * j] += d_red * band
            d_sh[into + 3 * j + 1] += d_green * band
            d_sh[into + 3 * j + 2] += d_blue * band


@inner
def grad_color_of_third(i, lane, view, colors, sums, bands_of, d_bands_of):
    """`grad_color` for harmonics of degree 3, to the same bits; bands lane by lane."""
    sh, d_sh, table, stride, wanted, start = colors
    at = i * stride
    d_red, d_green, d_blue = grad_shown(i, lane, view, table, sums)
    first, second, third = repeated(d_red, d_green, d_blue)
    one, two, three = load_three(sh, at)
    reds, greens, blues = apart((first * one, second * two, third * three))
    store(d_bands_of, lane * WIDTH, reds + greens + blues)
    if wanted:
        into, (one, two, three) = at - start * stride, thrice(load(bands_of, lane * WIDTH))
        store(d_sh, into, load(d_sh, into) + first * one)
        store(d_sh, into + WIDTH, load(d_sh, into + WIDTH) + second * two)
        store(d_sh, into + 2 * WIDTH, load(d_sh, into + 2 * WIDTH) + third * three)
