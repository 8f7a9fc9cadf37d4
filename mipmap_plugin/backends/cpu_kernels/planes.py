"""The state of a tile while its splats are laid over it or taken off again, 16 pixels at a time.

Pixels lie in planes of TILE_ROWS rows, each WIDTH longer than the tile, so that no run of 16 lanes needs an end of its own.
"""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.binning import TILE_COLUMNS, TILE_ROWS
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, bits, both, fma, minimum, select
from mipmap_plugin.backends.cpu_kernels.memory import load, store

STRIDE = TILE_COLUMNS + WIDTH
PLANE = TILE_ROWS * STRIDE

# Where planes begin in a tile's state: red, green and blue (in the backward pass dLoss/dimage), then
LIGHT = 3 * PLANE  # transmittance
ENDS = 4 * PLANE  # the place in the tile's list at which a pixel stopped
BEHIND = 5 * PLANE  # what lies behind the splat at hand, dotted with dLoss/dimage

# and, of the splat at hand, by rows: see `trace`.
BEGIN = 6 * PLANE
END, RIDGE, CREST = BEGIN + TILE_ROWS, BEGIN + 2 * TILE_ROWS, BEGIN + 3 * TILE_ROWS
STATE = BEGIN + 4 * TILE_ROWS


@inner
def cover(alpha, bright, limits, color, n, at, state):
    """Lay the n-th splat of a tile over the 16 pixels at `at`, where it is bright enough."""
    most, least, _ = limits
    alpha = minimum(alpha, most)
    before = load(state, LIGHT + at)
    after = before * (1 - alpha)
    shown = both(bright, after >= least)
    stopping = both(both(bright, before >= least), after < least)
    weight = select(shown, before * alpha, 0)
    store(state, at, fma(weight, color[0], load(state, at)))
    store(state, PLANE + at, fma(weight, color[1], load(state, PLANE + at)))
    store(state, 2 * PLANE + at, fma(weight, color[2], load(state, 2 * PLANE + at)))
    store(state, LIGHT + at, select(shown, after, select(stopping, 0 - before, before)))
    if bits(stopping) != 0:
        store(state, ENDS + at, select(stopping, n, load(state, ENDS + at)))


@inner
def uncover(alpha, bright, limits, color, n, at, state):
    """Take the n-th splat of a tile off the 16 pixels at `at`: alpha · dLoss/dalpha, dLoss/dalpha, its weight there, and dLoss/dimage."""
    most, _, _ = limits
    shown = both(bright, n < load(state, ENDS + at))
    light = select(shown, minimum(alpha, most), 0)
    before = load(state, LIGHT + at) / (1 - light)
    d_red, d_green, d_blue = load(state, at), load(state, PLANE + at), load(state, 2 * PLANE + at)
    behind = load(state, BEHIND + at)
    gain = fma(d_red, color[0], fma(d_green, color[1], d_blue * color[2])) - behind
    weight = before * light
    store(state, LIGHT + at, before)
    store(state, BEHIND + at, fma(light, gain, behind))
    rate = select(both(shown, alpha < most), before * gain, 0)
    return select(alpha < most, weight * gain, 0), rate, weight, d_red, d_green, d_blue


@inner
def feel(alpha, bright, color, n, at, state):
    """alpha · dLoss/dalpha of the n-th splat of a tile, which was culled, at the 16 pixels at `at`: as if it were faintly there."""
    shown = both(bright, n < load(state, ENDS + at))
    d_red, d_green, d_blue = load(state, at), load(state, PLANE + at), load(state, 2 * PLANE + at)
    gain = fma(d_red, color[0], fma(d_green, color[1], d_blue * color[2])) - load(state, BEHIND + at)
    return select(shown, load(state, LIGHT + at) * alpha * gain, 0)
