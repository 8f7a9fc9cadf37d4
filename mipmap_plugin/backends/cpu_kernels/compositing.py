"""Front-to-back compositing of tiles: splat by splat, over the rows of its ellipse, 16 pixels at a time.

`planes` updates the pixels themselves.
"""

# numba redefines calls and operators.
# mypy: ignore-errors

from numba import types

from mipmap_plugin.backends.cpu_kernels import inner, integrals, kernel, layout
from mipmap_plugin.backends.cpu_kernels.binning import LOG_MIN_ALPHA, SLACK, TILE_HEIGHT, TILE_WIDTH, tile_grid
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, bits, both, ceil, floor, fma, lowest_bit, maximum, minimum, ramp, sqrt
from mipmap_plugin.backends.cpu_kernels.memory import load, prefetch, row_of, scratch, store
from mipmap_plugin.backends.cpu_kernels.planes import (
    BEHIND_DOT_GRAD,
    PLANE,
    ROW_BEGIN,
    ROW_CENTER,
    ROW_END,
    ROW_PEAK,
    STATE_SIZE,
    STOPS,
    STRIDE,
    TRANSMITTANCE,
    blend,
)
from mipmap_plugin.backends.cpu_kernels.powers import exp2
from mipmap_plugin.backends.cpu_kernels.sorting import sort
from mipmap_plugin.effects import MIN_ALPHA

# Splats between two checks whether the tile is finished.
CHECK_EVERY = 16

new_state = scratch(STATE_SIZE, types.float32)

# Splats between prefetching a row of the table and using it.
PREFETCH_AHEAD = 4


@inner
def tile_box(tile, width, height):
    """Left, top, width and height of a tile, px."""
    tiles_x, _ = tile_grid(width, height)
    left, top = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
    return left, top, min(TILE_WIDTH, width - left), min(TILE_HEIGHT, height - top)


@inner
def outline_rows(splat, box, state):
    """Write a splat's outline in each row of a tile, and return a bit per row that it touches.

    Row r has in `state`, from ROW_BEGIN on: the first and last x, and the x and log2 alpha of the maximum.
    """
    left, top, width, height = box
    dy = ramp(top + 0.5 - splat[layout.Y])
    center = fma(dy, splat[layout.SHEAR], splat[layout.X] - left - 0.5)
    peak = fma(dy * dy, -splat[layout.FALL_Y], splat[layout.PEAK])
    half_width = sqrt(maximum(peak - LOG_MIN_ALPHA, 0) * splat[layout.PER_FALL_X]) + SLACK
    begin, end = maximum(ceil(center - half_width), 0), minimum(floor(center + half_width), width - 1)
    store(state, ROW_BEGIN, begin)
    store(state, ROW_END, end)
    store(state, ROW_CENTER, center)
    store(state, ROW_PEAK, peak)
    return bits(both(peak >= LOG_MIN_ALPHA, end >= begin)) & ((1 << height) - 1)


@kernel
def composite(start, stop, integrated, limits, table, lists, frame, outputs):
    """Render the tiles start..stop into `frame`, and into the outputs: image [H, W, 3] and alpha [H, W].

    integrated: True where splats are integrated over pixels, else None.
    """
    sort(start, stop, lists)
    starts, members, _, _ = lists
    _, transmittance, _ = frame
    height, width = transmittance.shape
    state = new_state()
    for tile in range(start, stop):
        box = tile_box(tile, width, height)
        length = starts[tile + 1] - starts[tile]
        init_tile(box, length, state)
        for n in range(length):
            if n % CHECK_EVERY == 0 and finished(state):
                break
            at = starts[tile] + n
            prefetch(table, members[min(at + PREFETCH_AHEAD, starts[stop] - 1)])
            splat = row_of(table, members[at])
            if integrated is not None:
                draw_integral(splat, limits, n, box, state)
            elif splat[layout.GATE] > 0:
                draw_splat(splat, limits, n, box, state)
        write_tile(box, state, frame, outputs)


@inner
def fill_range(state, first, last, value):
    for at in range(first, last):
        state[at] = value


@inner
def init_tile(box, length, state):
    """Clear the state. A negative transmittance marks a pixel that stopped, as all outside the image have from the start."""
    _, _, tile_width, tile_height = box
    fill_range(state, 0, TRANSMITTANCE, 0)
    fill_range(state, TRANSMITTANCE, STOPS, -1)
    fill_range(state, STOPS, BEHIND_DOT_GRAD, length)
    for r in range(tile_height):
        fill_range(state, TRANSMITTANCE + r * STRIDE, TRANSMITTANCE + r * STRIDE + tile_width, 1)


@inner
def finished(state):
    """Whether all pixels of the tile stopped."""
    largest = load(state, TRANSMITTANCE)
    for at in range(TRANSMITTANCE + WIDTH, STOPS, WIDTH):
        largest = maximum(largest, load(state, at))
    return bits(largest >= 0) == 0


@inner
def draw_splat(splat, limits, n, box, state):
    """Blend a splat, the n-th of its tile, behind those already blended."""
    fall, gain, offset = splat[layout.FALL_X], splat[layout.GAIN], splat[layout.OFFSET]
    color = splat[layout.RED], splat[layout.GREEN], splat[layout.BLUE]
    rows = outline_rows(splat, box, state)
    while rows != 0:
        r = lowest_bit(rows)
        rows &= rows - 1
        x, end, center, peak = state[ROW_BEGIN + r], state[ROW_END + r], state[ROW_CENTER + r], state[ROW_PEAK + r]
        at = r * STRIDE + int(x)
        while x <= end:
            u = ramp(x - center)
            power = fma(u * u, -fall, peak)
            blend(fma(exp2(power), gain, 0 - offset), power >= LOG_MIN_ALPHA, limits, color, n, at, state)
            x += WIDTH
            at += WIDTH


@inner
def draw_integral(splat, limits, n, box, state):
    """As `draw_splat`, for a splat that is integrated over pixels; `outline_rows` then outlines its bounding ellipse."""
    color = splat[layout.RED], splat[layout.GREEN], splat[layout.BLUE]
    rows = outline_rows(splat, box, state)
    while rows != 0:
        r = lowest_bit(rows)
        rows &= rows - 1
        x, end = state[ROW_BEGIN + r], state[ROW_END + r]
        at = r * STRIDE + int(x)
        center, dy = splat[layout.X] - box[0] - 0.5, box[1] + r + 0.5 - splat[layout.Y]
        while x <= end:
            alpha = integrals.alpha(splat, ramp(x - center), dy)
            blend(alpha, alpha >= MIN_ALPHA, limits, color, n, at, state)
            x += WIDTH
            at += WIDTH


@inner
def write_tile(box, state, frame, outputs):
    """Write a tile's pixels to the frame and the outputs."""
    left, top, tile_width, tile_height = box
    background, transmittance, stops = frame
    image, alpha = outputs
    for r in range(tile_height):
        for c in range(tile_width):
            at, y, x = r * STRIDE + c, top + r, left + c
            remaining = abs(state[TRANSMITTANCE + at])
            for k in range(3):
                image[y, x, k] = state[k * PLANE + at] + remaining * background[k]
            transmittance[y, x], alpha[y, x] = remaining, 1 - remaining
            stops[y, x] = state[STOPS + at]
