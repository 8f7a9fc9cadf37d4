"""Front-to-back "over" inside tiles, forward and backward: splat by splat, over the rows of its ellipse, 16 pixels at a time.

A tile's pixels lie in planes of TILE_ROWS rows, each WIDTH longer than the tile, so that no run of 16 lanes needs an end of its own.
"""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

import numpy as np

from mipmap_plugin.backends.compositing import MAX_ALPHA, MIN_TRANSMITTANCE
from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels import inner, kernel
from mipmap_plugin.backends.cpu_kernels.binning import LOG_MIN_ALPHA, SLACK, TILE_COLUMNS, TILE_ROWS, tile_grid
from mipmap_plugin.backends.cpu_kernels.lanes import (
    WIDTH,
    bits,
    both,
    ceil,
    exp2,
    floor,
    fma,
    load,
    lowest,
    maximum,
    minimum,
    prefetch,
    ramp,
    select,
    spread,
    sqrt,
    store,
    total,
)

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

# Splats between two looks at whether the tile is finished.
PATIENCE = 16

# Splats between asking for a row of the table and using it.
AHEAD = 4


@inner
def bounds(tile, width, height):
    """Left, top, columns and rows of a tile, px."""
    across, _ = tile_grid(width, height)
    left, top = tile % across * TILE_COLUMNS, tile // across * TILE_ROWS
    return left, top, min(TILE_COLUMNS, width - left), min(TILE_ROWS, height - top)


@inner
def trace(table, i, box, state):
    """Where splat i crosses the rows of a tile: a bit for each row that it lights, and into `state` at row r, from BEGIN on, the
    first column, the last column, the column of the ridge, and log2 alpha on the ridge."""
    left, top, columns, rows = box
    dy = ramp(top + 0.5 - table[i, col.Y])
    ridge = fma(dy, table[i, col.SHEAR], table[i, col.X] - left - 0.5)
    peak = fma(dy * dy, -table[i, col.FALL_Y], table[i, col.PEAK])
    half = sqrt(maximum(peak - LOG_MIN_ALPHA, 0) * table[i, col.SPREAD]) + SLACK
    begin, end = maximum(ceil(ridge - half), 0), minimum(floor(ridge + half), columns - 1)
    store(state, BEGIN, begin)
    store(state, END, end)
    store(state, RIDGE, ridge)
    store(state, CREST, peak)
    return bits(both(peak >= LOG_MIN_ALPHA, end >= begin)) & ((1 << rows) - 1)


@kernel
def composite(start, stop, table, lists, frame, image):
    """Render the tiles start..stop: fill the frame and the image [H, W, 3]."""
    starts, members, _ = lists
    background, through, stops = frame
    height, width = through.shape
    state = np.empty(STATE, np.float32)
    for tile in range(start, stop):
        box = bounds(tile, width, height)
        length = starts[tile + 1] - starts[tile]
        open_tile(box, length, state)
        for n in range(length):
            if n % PATIENCE == 0 and finished(state):
                break
            at = starts[tile] + n
            prefetch(table, members[min(at + AHEAD, len(members) - 1)])
            lay(table, members[at], n, box, state)
        close_tile(box, state, background, image, through, stops)


@inner
def open_tile(box, length, state):
    """Begin with an empty tile. Light below 0: a pixel that is finished, as all outside the image are from the start."""
    _, _, columns, rows = box
    state[:LIGHT] = 0
    state[LIGHT:ENDS] = -1
    state[ENDS:BEHIND] = length
    for r in range(rows):
        state[LIGHT + r * STRIDE : LIGHT + r * STRIDE + columns] = 1


@inner
def finished(state):
    """Whether no pixel of the tile lets any light through."""
    most = load(state, LIGHT)
    for at in range(LIGHT + WIDTH, ENDS, WIDTH):
        most = maximum(most, load(state, at))
    return bits(most >= 0) == 0


@inner
def lay(table, i, n, box, state):
    """Lay splat i, the n-th of its tile, behind what is there."""
    fall, red, green, blue = table[i, col.FALL_X], table[i, col.RED], table[i, col.GREEN], table[i, col.BLUE]
    rows = trace(table, i, box, state)
    while rows != 0:
        r = lowest(rows)
        rows &= rows - 1
        column, end, ridge, peak = state[BEGIN + r], state[END + r], state[RIDGE + r], state[CREST + r]
        at = r * STRIDE + int(column)
        while column <= end:
            u = ramp(column - ridge)
            power = fma(u * u, -fall, peak)
            alpha = minimum(exp2(power), MAX_ALPHA)
            before = load(state, LIGHT + at)
            after = before * (1 - alpha)
            bright = power >= LOG_MIN_ALPHA
            shown = both(bright, after >= MIN_TRANSMITTANCE)
            stopping = both(both(bright, before >= MIN_TRANSMITTANCE), after < MIN_TRANSMITTANCE)
            weight = select(shown, before * alpha, 0)
            store(state, at, fma(weight, red, load(state, at)))
            store(state, PLANE + at, fma(weight, green, load(state, PLANE + at)))
            store(state, 2 * PLANE + at, fma(weight, blue, load(state, 2 * PLANE + at)))
            store(state, LIGHT + at, select(shown, after, select(stopping, 0 - before, before)))
            if bits(stopping) != 0:
                store(state, ENDS + at, select(stopping, n, load(state, ENDS + at)))
            column += WIDTH
            at += WIDTH


@inner
def close_tile(box, state, background, image, through, stops):
    """Write a tile's pixels."""
    left, top, columns, rows = box
    for r in range(rows):
        for c in range(columns):
            at, y, x = r * STRIDE + c, top + r, left + c
            rest = abs(state[LIGHT + at])
            for k in range(3):
                image[y, x, k] = state[k * PLANE + at] + rest * background[k]
            through[y, x] = rest
            stops[y, x] = state[ENDS + at]


@kernel
def composite_back(start, stop, table, lists, frame, d_frame, pulls):
    """Walk the lists of the tiles start..stop back to front and write each splat's pull in each tile into its slot.

    d_frame: the gradients of the image [H, W, 3] and of its alpha [H, W].
    """
    starts, members, slots = lists
    background, through, stops = frame
    d_image, d_alpha = d_frame
    height, width = through.shape
    state = np.empty(STATE, np.float32)
    for tile in range(start, stop):
        box = bounds(tile, width, height)
        used = reopen_tile(box, background, through, stops, d_image, d_alpha, state)
        for at in range(starts[tile] + used, starts[tile + 1]):
            for k in range(col.PULLS):
                pulls[slots[at], k] = 0
        for n in range(used - 1, -1, -1):
            at = starts[tile] + n
            prefetch(table, members[max(at - AHEAD, 0)])
            lift(table, members[at], n, box, state, pulls, slots[at])


@inner
def reopen_tile(box, background, through, stops, d_image, d_alpha, state):
    """Begin with a finished tile; returns how many of its splats were used."""
    left, top, columns, rows = box
    state[:] = 0
    state[LIGHT:ENDS] = 1
    used = 0
    for r in range(rows):
        for c in range(columns):
            at, y, x = r * STRIDE + c, top + r, left + c
            behind = -d_alpha[y, x]
            for k in range(3):
                state[k * PLANE + at] = d_image[y, x, k]
                behind += background[k] * d_image[y, x, k]
            state[LIGHT + at], state[ENDS + at], state[BEHIND + at] = through[y, x], stops[y, x], behind
            used = max(used, int(stops[y, x]))
    return used


@inner
def lift(table, i, n, box, state, pulls, slot):
    """Take splat i, the n-th of its tile, off again and write its pull."""
    fall, red, green, blue = table[i, col.FALL_X], table[i, col.RED], table[i, col.GREEN], table[i, col.BLUE]
    sum_1 = sum_u = sum_y = sum_uu = sum_uy = sum_yy = sum_red = sum_green = sum_blue = spread(0)
    rows = trace(table, i, box, state)
    while rows != 0:
        r = lowest(rows)
        rows &= rows - 1
        column, end, ridge, peak = state[BEGIN + r], state[END + r], state[RIDGE + r], state[CREST + r]
        at = r * STRIDE + int(column)
        dy = box[1] + r + 0.5 - table[i, col.Y]
        while column <= end:
            u = ramp(column - ridge)
            power = fma(u * u, -fall, peak)
            raw = exp2(power)
            shown = both(power >= LOG_MIN_ALPHA, n < load(state, ENDS + at))
            alpha = select(shown, minimum(raw, MAX_ALPHA), 0)
            before = load(state, LIGHT + at) / (1 - alpha)
            d_red, d_green, d_blue = load(state, at), load(state, PLANE + at), load(state, 2 * PLANE + at)
            behind = load(state, BEHIND + at)
            gain = fma(d_red, red, fma(d_green, green, d_blue * blue)) - behind
            weight = before * alpha
            store(state, LIGHT + at, before)
            store(state, BEHIND + at, fma(alpha, gain, behind))
            s = select(raw < MAX_ALPHA, weight * gain, 0)
            s_u, s_y = s * u, s * dy
            sum_1, sum_u, sum_y = sum_1 + s, sum_u + s_u, sum_y + s_y
            sum_uu, sum_uy, sum_yy = fma(s_u, u, sum_uu), fma(s_u, dy, sum_uy), fma(s_y, dy, sum_yy)
            sum_red, sum_green, sum_blue = fma(weight, d_red, sum_red), fma(weight, d_green, sum_green), fma(weight, d_blue, sum_blue)
            column += WIDTH
            at += WIDTH
    pulls[slot, col.SUM], pulls[slot, col.SUM_U], pulls[slot, col.SUM_Y] = total(sum_1), total(sum_u), total(sum_y)
    pulls[slot, col.SUM_UU], pulls[slot, col.SUM_UY], pulls[slot, col.SUM_YY] = total(sum_uu), total(sum_uy), total(sum_yy)
    pulls[slot, col.RED], pulls[slot, col.GREEN], pulls[slot, col.BLUE] = total(sum_red), total(sum_green), total(sum_blue)
