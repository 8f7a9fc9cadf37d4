"""The pixels of a tile while its splats are blended in or, in the backward pass, removed again, 16 pixels at a time.

Each quantity of the tile's pixels is a plane of TILE_HEIGHT rows, each WIDTH longer than the tile, so that 16 lanes never run past it.
"""

# numba redefines calls and operators.
# mypy: ignore-errors

from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.binning import TILE_HEIGHT, TILE_WIDTH
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, bits, both, fma, minimum, select
from mipmap_plugin.backends.cpu_kernels.memory import load, store

STRIDE = TILE_WIDTH + WIDTH
PLANE = TILE_HEIGHT * STRIDE

# Offsets of planes in a tile's state: red, green and blue (in the backward pass dLoss/dimage), then
TRANSMITTANCE = 3 * PLANE  # behind the splats so far; negative: the pixel stopped
STOPS = 4 * PLANE  # the position in the tile's list at which the pixel stopped
BEHIND_DOT_GRAD = 5 * PLANE  # the color behind the current splat, dotted with dLoss/dimage

# and, for the current splat, numbers per row of the tile (`compositing.outline_rows`).
ROW_BEGIN = 6 * PLANE
ROW_END, ROW_CENTER, ROW_PEAK = ROW_BEGIN + TILE_HEIGHT, ROW_BEGIN + 2 * TILE_HEIGHT, ROW_BEGIN + 3 * TILE_HEIGHT
STATE_SIZE = ROW_BEGIN + 4 * TILE_HEIGHT


@inner
def blend(alpha, bright, limits, color, n, at, state):
    """Blend the n-th splat of a tile into the 16 pixels at `at`, where it is bright enough."""
    max_alpha, min_transmittance, _ = limits
    alpha = minimum(alpha, max_alpha)
    before = load(state, TRANSMITTANCE + at)
    after = before * (1 - alpha)
    visible = both(bright, after >= min_transmittance)
    stopping = both(both(bright, before >= min_transmittance), after < min_transmittance)
    weight = select(visible, before * alpha, 0)
    store(state, at, fma(weight, color[0], load(state, at)))
    store(state, PLANE + at, fma(weight, color[1], load(state, PLANE + at)))
    store(state, 2 * PLANE + at, fma(weight, color[2], load(state, 2 * PLANE + at)))
    store(state, TRANSMITTANCE + at, select(visible, after, select(stopping, 0 - before, before)))
    if bits(stopping) != 0:
        store(state, STOPS + at, select(stopping, n, load(state, STOPS + at)))


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
