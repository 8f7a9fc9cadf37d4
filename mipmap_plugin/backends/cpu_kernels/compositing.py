"""Front-to-back "over" inside tiles, forward and backward: splat by splat, over the rows of its ellipse, 16 pixels at a time.

What happens to the pixels themselves is in `planes`.
"""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

from numba import types

from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels import inner, integrals, kernel
from mipmap_plugin.backends.cpu_kernels.binning import LOG_MIN_ALPHA, SLACK, TILE_COLUMNS, TILE_ROWS, tile_grid
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, bits, both, ceil, floor, fma, lowest, maximum, minimum, ramp, spread, sqrt, total
from mipmap_plugin.backends.cpu_kernels.memory import load, prefetch, row_of, scratch, store
from mipmap_plugin.backends.cpu_kernels.planes import BEGIN, BEHIND, CREST, END, ENDS, LIGHT, PLANE, RIDGE, STATE, STRIDE, cover, feel, uncover
from mipmap_plugin.backends.cpu_kernels.powers import exp2
from mipmap_plugin.backends.cpu_kernels.sorting import sort
from mipmap_plugin.effects import MIN_ALPHA

# Splats between two looks at whether the tile is finished.
PATIENCE = 16

new_state = scratch(STATE, types.float32)

# Splats between asking for a row of the table and using it.
AHEAD = 4


@inner
def bounds(tile, width, height):
    """Left, top, columns and rows of a tile, px."""
    across, _ = tile_grid(width, height)
    left, top = tile % across * TILE_COLUMNS, tile // across * TILE_ROWS
    return left, top, min(TILE_COLUMNS, width - left), min(TILE_ROWS, height - top)


@inner
def trace(splat, box, state):
    """Where a splat crosses the rows of a tile: a bit for each row that it lights, and into `state` at row r, from BEGIN on, the
    first column, the last column, the column of the ridge, and log2 alpha on the ridge."""
    left, top, columns, rows = box
    dy = ramp(top + 0.5 - splat[col.Y])
    ridge = fma(dy, splat[col.SHEAR], splat[col.X] - left - 0.5)
    peak = fma(dy * dy, -splat[col.FALL_Y], splat[col.PEAK])
    half = sqrt(maximum(peak - LOG_MIN_ALPHA, 0) * splat[col.SPREAD]) + SLACK
    begin, end = maximum(ceil(ridge - half), 0), minimum(floor(ridge + half), columns - 1)
    store(state, BEGIN, begin)
    store(state, END, end)
    store(state, RIDGE, ridge)
    store(state, CREST, peak)
    return bits(both(peak >= LOG_MIN_ALPHA, end >= begin)) & ((1 << rows) - 1)


@kernel
def composite(start, stop, integrated, limits, table, lists, frame, shown):
    """Render the tiles start..stop: fill the frame, and the image [H, W, 3] and alpha [H, W] that are shown.

    integrated: splats are, over each pixel's square.
    """
    sort(start, stop, lists)
    starts, members, _, _ = lists
    _, through, _ = frame
    height, width = through.shape
    state = new_state()
    for tile in range(start, stop):
        box = bounds(tile, width, height)
        length = starts[tile + 1] - starts[tile]
        open_tile(box, length, state)
        for n in range(length):
            if n % PATIENCE == 0 and finished(state):
                break
            at = starts[tile] + n
            prefetch(table, members[min(at + AHEAD, starts[stop] - 1)])
            splat = row_of(table, members[at])
            if integrated:
                lay_integral(splat, limits, n, box, state)
            elif splat[col.GATE] > 0:
                lay(splat, limits, n, box, state)
        close_tile(box, state, frame, shown)


@inner
def fill(state, first, last, value):
    for at in range(first, last):
        state[at] = value


@inner
def open_tile(box, length, state):
    """Begin with an empty tile. Light below 0: a pixel that is finished, as all outside the image are from the start."""
    _, _, columns, rows = box
    fill(state, 0, LIGHT, 0)
    fill(state, LIGHT, ENDS, -1)
    fill(state, ENDS, BEHIND, length)
    for r in range(rows):
        fill(state, LIGHT + r * STRIDE, LIGHT + r * STRIDE + columns, 1)


@inner
def finished(state):
    """Whether no pixel of the tile lets any light through."""
    most = load(state, LIGHT)
    for at in range(LIGHT + WIDTH, ENDS, WIDTH):
        most = maximum(most, load(state, at))
    return bits(most >= 0) == 0


@inner
def lay(splat, limits, n, box, state):
    """Lay a splat, the n-th of its tile, behind what is there."""
    fall, gain, floor = splat[col.FALL_X], splat[col.GAIN], splat[col.FLOOR]
    color = splat[col.RED], splat[col.GREEN], splat[col.BLUE]
    rows = trace(splat, box, state)
    while rows != 0:
        r = lowest(rows)
        rows &= rows - 1
        column, end, ridge, peak = state[BEGIN + r], state[END + r], state[RIDGE + r], state[CREST + r]
        at = r * STRIDE + int(column)
        while column <= end:
            u = ramp(column - ridge)
            power = fma(u * u, -fall, peak)
            cover(fma(exp2(power), gain, 0 - floor), power >= LOG_MIN_ALPHA, limits, color, n, at, state)
            column += WIDTH
            at += WIDTH


@inner
def lay_integral(splat, limits, n, box, state):
    """As `lay`, of a splat that is integrated over pixels; what `trace` finds is an ellipse around it."""
    color = splat[col.RED], splat[col.GREEN], splat[col.BLUE]
    rows = trace(splat, box, state)
    while rows != 0:
        r = lowest(rows)
        rows &= rows - 1
        column, end = state[BEGIN + r], state[END + r]
        at = r * STRIDE + int(column)
        center, dy = splat[col.X] - box[0] - 0.5, box[1] + r + 0.5 - splat[col.Y]
        while column <= end:
            alpha = integrals.alpha(splat, ramp(column - center), dy)
            cover(alpha, alpha >= MIN_ALPHA, limits, color, n, at, state)
            column += WIDTH
            at += WIDTH


@inner
def close_tile(box, state, frame, shown):
    """Write a tile's pixels."""
    left, top, columns, rows = box
    background, through, stops = frame
    image, alpha = shown
    for r in range(rows):
        for c in range(columns):
            at, y, x = r * STRIDE + c, top + r, left + c
            rest = abs(state[LIGHT + at])
            for k in range(3):
                image[y, x, k] = state[k * PLANE + at] + rest * background[k]
            through[y, x], alpha[y, x] = rest, 1 - rest
            stops[y, x] = state[ENDS + at]


@kernel
def composite_back(start, stop, integrated, limits, table, lists, frame, d_frame, pulls):
    """Walk the lists of the tiles start..stop back to front and write each splat's pull in each tile into its slot.

    d_frame: the gradients of the image [H, W, 3] and of its alpha [H, W].
    """
    starts, members, slots, _ = lists
    background, through, stops = frame
    d_image, d_alpha = d_frame
    height, width = through.shape
    state = new_state()
    for tile in range(start, stop):
        box = bounds(tile, width, height)
        used = reopen_tile(box, background, through, stops, d_image, d_alpha, state)
        for at in range(starts[tile] + used, starts[tile + 1]):
            for k in range(col.PULLS):
                pulls[slots[at], k] = 0
        for n in range(used - 1, -1, -1):
            at = starts[tile] + n
            prefetch(table, members[max(at - AHEAD, 0)])
            splat, pull = row_of(table, members[at]), row_of(pulls, slots[at])
            if integrated:
                lift_integral(splat, limits, n, box, state, pull)
            elif splat[col.GATE] == 0:
                lift_culled(splat, n, box, state, pull)
            elif splat[col.FLOOR] > 0:
                lift(splat, limits, True, n, box, state, pull)
            else:
                lift(splat, limits, False, n, box, state, pull)


@inner
def reopen_tile(box, background, through, stops, d_image, d_alpha, state):
    """Begin with a finished tile; returns how many of its splats were used."""
    left, top, columns, rows = box
    fill(state, 0, STATE, 0)
    fill(state, LIGHT, ENDS, 1)
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
def lift(splat, limits, fades, n, box, state, pull):
    """Take a splat, the n-th of its tile, off again and write its pull. fades: known when this is compiled, so that what does not costs nothing."""
    fall, gain, floor = splat[col.FALL_X], splat[col.GAIN], splat[col.FLOOR]
    color = splat[col.RED], splat[col.GREEN], splat[col.BLUE]
    sum_1 = sum_u = sum_y = sum_uu = sum_uy = sum_yy = sum_red = sum_green = sum_blue = spread(0)
    rows = trace(splat, box, state)
    while rows != 0:
        r = lowest(rows)
        rows &= rows - 1
        column, end, ridge, peak = state[BEGIN + r], state[END + r], state[RIDGE + r], state[CREST + r]
        at = r * STRIDE + int(column)
        dy = box[1] + r + 0.5 - splat[col.Y]
        while column <= end:
            u = ramp(column - ridge)
            power = fma(u * u, -fall, peak)
            alpha = fma(exp2(power), gain, 0 - floor)
            s, rate, weight, d_red, d_green, d_blue = uncover(alpha, power >= LOG_MIN_ALPHA, limits, color, n, at, state)
            sum_1 = sum_1 + s
            if fades:
                s = fma(rate, floor, s)  # a floor depends on no shape
            s_u, s_y = s * u, s * dy
            sum_u, sum_y = sum_u + s_u, sum_y + s_y
            sum_uu, sum_uy, sum_yy = fma(s_u, u, sum_uu), fma(s_u, dy, sum_uy), fma(s_y, dy, sum_yy)
            sum_red, sum_green, sum_blue = fma(weight, d_red, sum_red), fma(weight, d_green, sum_green), fma(weight, d_blue, sum_blue)
            column += WIDTH
            at += WIDTH
    pull[col.SUM], pull[col.SUM_U], pull[col.SUM_Y] = total(sum_1), total(sum_u), total(sum_y)
    pull[col.SUM_UU], pull[col.SUM_UY], pull[col.SUM_YY] = total(sum_uu), total(sum_uy), total(sum_yy)
    pull[col.PULL_RED], pull[col.PULL_GREEN], pull[col.PULL_BLUE] = total(sum_red), total(sum_green), total(sum_blue)


@inner
def lift_culled(splat, n, box, state, pull):
    """Write the pull of a splat that is not drawn, on its gate alone."""
    fall, gain, floor = splat[col.FALL_X], splat[col.GAIN], splat[col.FLOOR]
    color, sum_1 = (splat[col.RED], splat[col.GREEN], splat[col.BLUE]), spread(0)
    rows = trace(splat, box, state)
    while rows != 0:
        r = lowest(rows)
        rows &= rows - 1
        column, end, ridge, peak = state[BEGIN + r], state[END + r], state[RIDGE + r], state[CREST + r]
        at = r * STRIDE + int(column)
        while column <= end:
            u = ramp(column - ridge)
            power = fma(u * u, -fall, peak)
            sum_1 = sum_1 + feel(fma(exp2(power), gain, 0 - floor), power >= LOG_MIN_ALPHA, color, n, at, state)
            column += WIDTH
            at += WIDTH
    for k in range(col.PULLS):
        pull[k] = 0
    pull[col.SUM] = total(sum_1)


@inner
def lift_integral(splat, limits, n, box, state, pull):
    """As `lift`, of a splat that is integrated over pixels."""
    color = splat[col.RED], splat[col.GREEN], splat[col.BLUE]
    sum_1 = sum_long = sum_short = sum_grow_long = sum_grow_short = sum_turn = sum_red = sum_green = sum_blue = spread(0)
    rows = trace(splat, box, state)
    while rows != 0:
        r = lowest(rows)
        rows &= rows - 1
        column, end = state[BEGIN + r], state[END + r]
        at = r * STRIDE + int(column)
        center, dy = splat[col.X] - box[0] - 0.5, box[1] + r + 0.5 - splat[col.Y]
        while column <= end:
            alpha, by_long, by_short, grow_long, grow_short, turn = integrals.slopes(splat, ramp(column - center), dy)
            s, _, weight, d_red, d_green, d_blue = uncover(alpha, alpha >= MIN_ALPHA, limits, color, n, at, state)
            sum_1, sum_long, sum_short = sum_1 + s, fma(s, by_long, sum_long), fma(s, by_short, sum_short)
            sum_grow_long, sum_grow_short = fma(s, grow_long, sum_grow_long), fma(s, grow_short, sum_grow_short)
            sum_turn = fma(s, turn, sum_turn)
            sum_red, sum_green, sum_blue = fma(weight, d_red, sum_red), fma(weight, d_green, sum_green), fma(weight, d_blue, sum_blue)
            column += WIDTH
            at += WIDTH
    pull[col.SUM], pull[col.BY_LONG], pull[col.BY_SHORT] = total(sum_1), total(sum_long), total(sum_short)
    pull[col.GROW_LONG], pull[col.GROW_SHORT], pull[col.TURN] = total(sum_grow_long), total(sum_grow_short), total(sum_turn)
    pull[col.PULL_RED], pull[col.PULL_GREEN], pull[col.PULL_BLUE] = total(sum_red), total(sum_green), total(sum_blue)
