"""The pixels of a tile while its splats are blended in or, in the backward pass, removed again, a patch of 4 x 4 pixels at a time.

Each quantity of the tile's pixels is a plane: patch after patch, row by row, and in each patch row by row. A patch is one set of
lanes, always at the same place in memory: what one splat stores the next one loads without waiting.
"""

# numba redefines calls and operators.
# mypy: ignore-errors

import numpy as np
from numba import types

from mipmap_plugin.backends.cpu_kernels import inner, layout
from mipmap_plugin.backends.cpu_kernels.binning import TILE_HEIGHT, TILE_WIDTH
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, absolute, across, bits, both, down, fma, minimum, select
from mipmap_plugin.backends.cpu_kernels.memory import load, scratch, store

# px: the width and height of a patch.
PATCH = 4

# Patches in a row of a tile, and in a tile: a set of them is the bits of an integer.
PATCH_COLUMNS = TILE_WIDTH // PATCH
PATCHES = PATCH_COLUMNS * TILE_HEIGHT // PATCH
PLANE = PATCHES * WIDTH

# Offsets of planes in a tile's state: red, green and blue (in the backward pass dLoss/dimage), then
TRANSMITTANCE = 3 * PLANE  # behind the splats so far; negative: the pixel stopped
STOPS = 4 * PLANE  # the position in the tile's list at which the pixel stopped
BEHIND_DOT_GRAD = 5 * PLANE  # the color behind the current splat, dotted with dLoss/dimage
STATE_SIZE = 6 * PLANE

new_state = scratch(STATE_SIZE, types.float32)


@inner
def offset_of(row, column):
    """Where the four pixels of a tile's row that begin at `column`, a multiple of 4, are in a plane."""
    return (row // PATCH * PATCH_COLUMNS + column // PATCH) * WIDTH + row % PATCH * PATCH


@inner
def distances(splat, patch, box):
    """px from a splat's center to the pixels' centers of a patch, in x and in y."""
    left, top, _, _ = box
    dx, dy = np.float32(left + 0.5) - splat[layout.X], np.float32(top + 0.5) - splat[layout.Y]
    column, row = np.float32(patch % PATCH_COLUMNS * PATCH), np.float32(patch // PATCH_COLUMNS * PATCH)
    return across(dx + column), down(dy + row)


@inner
def blend(alpha, bright, limits, color, n, at, state):
    """Blend the n-th splat of a tile into the patch at `at`, where it is bright enough."""
    max_alpha, min_transmittance, _ = limits
    alpha, before = select(bright, minimum(alpha, max_alpha), 0), load(state, TRANSMITTANCE + at)
    after = before * (1 - alpha)
    is_open = after >= min_transmittance  # the pixel stopped neither before this splat nor at it
    weight = select(is_open, before * alpha, 0)
    store(state, at, fma(weight, color[0], load(state, at)))
    store(state, PLANE + at, fma(weight, color[1], load(state, PLANE + at)))
    store(state, 2 * PLANE + at, fma(weight, color[2], load(state, 2 * PLANE + at)))
    store(state, TRANSMITTANCE + at, select(is_open, after, -absolute(before)))
    stops = both(before >= 0, after < min_transmittance)
    if bits(stops) != 0:
        store(state, STOPS + at, select(stops, n, load(state, STOPS + at)))


@inner
def unblend(alpha, bright, limits, color, n, at, state):
    """Remove the n-th splat of a tile from the 16 pixels at `at`.

    Returns alpha · dLoss/dalpha, dLoss/dalpha, the blend weight, and dLoss/dimage.
    """
    max_alpha, _, _ = limits
    visible = both(bright, n < load(state, STOPS + at))
    clamped = select(visible, minimum(alpha, max_alpha), 0)
    before = load(state, TRANSMITTANCE + at) / (1 - clamped)
    d_red, d_green, d_blue = load(state, at), load(state, PLANE + at), load(state, 2 * PLANE + at)
    behind = load(state, BEHIND_DOT_GRAD + at)
    slope = fma(d_red, color[0], fma(d_green, color[1], d_blue * color[2])) - behind
    weight = before * clamped
    store(state, TRANSMITTANCE + at, before)
    store(state, BEHIND_DOT_GRAD + at, fma(clamped, slope, behind))
    d_alpha = select(both(visible, alpha < max_alpha), before * slope, 0)
    return select(alpha < max_alpha, weight * slope, 0), d_alpha, weight, d_red, d_green, d_blue


@inner
def grad_culled(alpha, bright, color, n, at, state):
    """alpha · dLoss/dalpha of the n-th splat of a tile, which is culled, at the 16 pixels at `at`, in the limit of a faint splat."""
    visible = both(bright, n < load(state, STOPS + at))
    d_red, d_green, d_blue = load(state, at), load(state, PLANE + at), load(state, 2 * PLANE + at)
    slope = fma(d_red, color[0], fma(d_green, color[1], d_blue * color[2])) - load(state, BEHIND_DOT_GRAD + at)
    return select(visible, load(state, TRANSMITTANCE + at) * alpha * slope, 0)
