"""Front-to-back "over" through windows, forward and backward: as `compositing`, but what a splat shows depends on those in front.

Windows cannot be undone like transmittance. The backward pass walks forward first and keeps every window that a splat was seen through.
"""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

import numpy as np
from numba import types

from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels import inner, kernel, windows
from mipmap_plugin.backends.cpu_kernels.binning import LOG_MIN_ALPHA, TILE_COLUMNS, TILE_ROWS
from mipmap_plugin.backends.cpu_kernels.compositing import AHEAD, PATIENCE, bounds, close_tile, fill, finished, open_tile, reopen_tile, trace
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, bits, both, fma, lowest, ramp, select, spread, total
from mipmap_plugin.backends.cpu_kernels.memory import load, pointer, prefetch, row_of, scratch, store
from mipmap_plugin.backends.cpu_kernels.planes import BEGIN, END, ENDS, LIGHT, PLANE, STATE, STRIDE, cover, uncover
from mipmap_plugin.backends.cpu_kernels.sorting import sort
from mipmap_plugin.effects import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

USUAL = (MAX_ALPHA, MIN_TRANSMITTANCE, 0.0)

# Where the planes of windows begin in a tile's state: x, y, width, height; in the backward pass their gradients.
WINDOWS = STATE
ROOM = STATE + 4 * PLANE
new_room = scratch(ROOM, types.float32)

# Of one visit to 16 pixels the windows are kept: so many numbers. A splat makes at most MOST visits in a tile.
KEPT = 4 * WIDTH
MOST = TILE_ROWS * (TILE_COLUMNS // WIDTH + 1)


@kernel
def composite(start, stop, table, lists, frame, shown):
    """Render the tiles start..stop: fill the frame, and the image [H, W, 3] and alpha [H, W] that are shown."""
    sort(start, stop, lists)
    starts, members, _, _ = lists
    _, through, _ = frame
    height, width = through.shape
    state, nowhere = new_room(), (pointer(table), pointer(starts), False)
    for tile in range(start, stop):
        box = bounds(tile, width, height)
        length = starts[tile + 1] - starts[tile]
        open_windows(box, length, state)
        for n in range(length):
            if n % PATIENCE == 0 and finished(state):
                break
            at = starts[tile] + n
            prefetch(table, members[min(at + AHEAD, starts[stop] - 1)])
            splat = row_of(table, members[at])
            lay(splat, n, box, state, nowhere, 0)
        close_tile(box, state, frame, shown)


@inner
def open_windows(box, length, state):
    """Begin with an empty tile: each window is its pixel."""
    open_tile(box, length, state)
    fill(state, WINDOWS, WINDOWS + 2 * PLANE, 0)
    fill(state, WINDOWS + 2 * PLANE, ROOM, 1)


@inner
def load_windows(state, at, apart):
    return load(state, at), load(state, at + apart), load(state, at + 2 * apart), load(state, at + 3 * apart)


@inner
def store_windows(state, at, apart, window):
    store(state, at, window[0])
    store(state, at + apart, window[1])
    store(state, at + 2 * apart, window[2])
    store(state, at + 3 * apart, window[3])


@inner
def choose(mask, yes, no):
    """`select`, of windows."""
    return select(mask, yes[0], no[0]), select(mask, yes[1], no[1]), select(mask, yes[2], no[2]), select(mask, yes[3], no[3])


@inner
def look(shape, room, dx, dy, unfinished, color, n, at, state, memory, visits):
    """Lay a splat over the 16 pixels at `at`, as their windows show it. 1 if it is seen at all, else 0."""
    window = load_windows(state, WINDOWS + at, PLANE)
    if bits(both(unfinished, windows.reached(shape, room, dx, dy, window))) == 0:
        return 0
    alpha, seen = windows.look(shape, dx, dy, window)
    bright = both(alpha >= MIN_ALPHA, unfinished)
    if bits(bright) == 0:
        return 0
    kept, places, keep = memory
    if keep:
        store_windows(kept, visits * KEPT, WIDTH, window)
        places[visits] = at
    cover(alpha, bright, USUAL, color, n, at, state)
    after = windows.kept(windows.behind(shape, window, alpha, seen)[0])
    store_windows(state, WINDOWS + at, PLANE, choose(bright, after, window))
    return 1


@inner
def lay(splat, n, box, state, memory, visits):
    """Lay a splat, the n-th of its tile, behind what is there, and count its visits.

    memory: where the windows that it was seen through are kept, where the places, and whether they are.
    """
    color, shape = (splat[col.RED], splat[col.GREEN], splat[col.BLUE]), windows.shape_of(splat)
    room, rows = splat[col.PEAK] - LOG_MIN_ALPHA, trace(splat, box, state)
    while rows != 0:
        r = lowest(rows)
        rows &= rows - 1
        column, end = state[BEGIN + r], state[END + r]
        at = r * STRIDE + int(column)
        center, dy = splat[col.X] - box[0] - 0.5, box[1] + r + 0.5 - splat[col.Y]
        while column <= end:
            unfinished = both(load(state, LIGHT + at) >= 0, end >= ramp(column))
            if bits(unfinished) != 0:
                visits += look(shape, room, ramp(column - center), dy, unfinished, color, n, at, state, memory, visits)
            column += WIDTH
            at += WIDTH
    return visits


@kernel
def composite_back(start, stop, table, lists, frame, d_frame, pulls):
    """Walk the lists of the tiles start..stop back to front and write each splat's pull in each tile into its slot.

    d_frame: the gradients of the image [H, W, 3] and of its alpha [H, W].
    """
    starts, members, slots, _ = lists
    background, through, stops = frame
    d_image, d_alpha = d_frame
    height, width = through.shape
    state, kept, places = new_room(), np.empty(16 * MOST * KEPT, np.float32), np.empty(16 * MOST, np.int64)
    for tile in range(start, stop):
        box = bounds(tile, width, height)
        length = starts[tile + 1] - starts[tile]
        firsts, visits = np.zeros(length + 1, np.int64), 0
        open_windows(box, length, state)
        for n in range(length):
            if n % PATIENCE == 0 and finished(state):
                break
            if visits + MOST > len(places):
                kept, places = np.append(kept, np.empty_like(kept)), np.append(places, np.empty_like(places))
            memory = pointer(kept), pointer(places), True
            visits = lay(row_of(table, members[starts[tile] + n]), n, box, state, memory, visits)
            firsts[n + 1] = visits

        used = reopen_tile(box, background, through, stops, d_image, d_alpha, state)
        fill(state, WINDOWS, ROOM, 0)
        for at in range(starts[tile] + used, starts[tile + 1]):
            for k in range(col.PULLS):
                pulls[slots[at], k] = 0
        for n in range(used - 1, -1, -1):
            at = starts[tile] + n
            prefetch(table, members[max(at - AHEAD, 0)])
            splat, pull = row_of(table, members[at]), row_of(pulls, slots[at])
            lift(splat, n, box, state, memory, (firsts[n], firsts[n + 1]), pull)


@inner
def lift(splat, n, box, state, memory, visits, pull):
    """Take a splat, the n-th of its tile, off again and write its pull."""
    kept, places, _ = memory
    color, shape = (splat[col.RED], splat[col.GREEN], splat[col.BLUE]), windows.shape_of(splat)
    sum_1 = sum_u = sum_v = sum_long = sum_short = sum_turn = sum_red = sum_green = sum_blue = spread(0)
    for visit in range(visits[0], visits[1]):
        at, window = places[visit], load_windows(kept, visit * KEPT, WIDTH)
        r = at // STRIDE
        dx, dy = ramp(at - r * STRIDE - (splat[col.X] - box[0] - 0.5)), box[1] + r + 0.5 - splat[col.Y]
        alpha, seen = windows.look(shape, dx, dy, window)
        bright = alpha >= MIN_ALPHA
        shown = both(bright, n < load(state, ENDS + at))
        s, _, weight, d_red, d_green, d_blue = uncover(alpha, bright, USUAL, color, n, at, state)
        after, outcome = windows.behind(shape, window, alpha, seen)
        d_window = load_windows(state, WINDOWS + at, PLANE)
        d_before, s, slopes = windows.pull_behind(shape, alpha, s, seen, outcome, windows.pull_kept(after, d_window))
        store_windows(state, WINDOWS + at, PLANE, choose(shown, d_before, d_window))
        sum_1, sum_u, sum_v = sum_1 + select(shown, s, 0), sum_u + select(shown, slopes[0], 0), sum_v + select(shown, slopes[1], 0)
        sum_long, sum_short = sum_long + select(shown, slopes[2], 0), sum_short + select(shown, slopes[3], 0)
        sum_turn = sum_turn + select(shown, slopes[4], 0)
        sum_red, sum_green, sum_blue = fma(weight, d_red, sum_red), fma(weight, d_green, sum_green), fma(weight, d_blue, sum_blue)
    pull[col.SUM], pull[col.BY_LONG], pull[col.BY_SHORT] = total(sum_1), total(sum_u) / shape[3], total(sum_v) / shape[4]
    pull[col.GROW_LONG], pull[col.GROW_SHORT], pull[col.TURN] = total(sum_long), total(sum_short), total(sum_turn)
    pull[col.PULL_RED], pull[col.PULL_GREEN], pull[col.PULL_BLUE] = total(sum_red), total(sum_green), total(sum_blue)
