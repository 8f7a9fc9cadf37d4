"""Pictures of few bits: the image once more, back to front, rounded after each splat. Its gradient is that of the image that is not."""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels import inner, kernel
from mipmap_plugin.backends.cpu_kernels.binning import LOG_MIN_ALPHA
from mipmap_plugin.backends.cpu_kernels.compositing import AHEAD, bounds, fill, new_state, trace
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, fma, lowest, maximum, minimum, ramp, select
from mipmap_plugin.backends.cpu_kernels.memory import load, prefetch, row_of, store
from mipmap_plugin.backends.cpu_kernels.planes import BEGIN, CREST, END, PLANE, RIDGE, STRIDE
from mipmap_plugin.backends.cpu_kernels.powers import exp2

# 1.5 · 2^23: added to a float32 and taken off again, it leaves the nearest integer.
ROUNDER = 12582912.0


@kernel
def composite(start, stop, limits, table, lists, frame, shown):
    """Draw the image [H, W, 3] of the tiles start..stop again; their lists are sorted."""
    starts, members, _, _ = lists
    background, through, _ = frame
    image, _ = shown
    height, width = through.shape
    state = new_state()
    for tile in range(start, stop):
        box = bounds(tile, width, height)
        left, top, columns, rows = box
        for k in range(3):
            fill(state, k * PLANE, (k + 1) * PLANE, background[k])
        for at in range(starts[tile + 1] - 1, starts[tile] - 1, -1):
            prefetch(table, members[max(at - AHEAD, starts[tile])])
            splat = row_of(table, members[at])
            if splat[col.GATE] > 0:
                lay(splat, limits, box, state)
        for r in range(rows):
            for c in range(columns):
                for k in range(3):
                    image[top + r, left + c, k] = state[k * PLANE + r * STRIDE + c]


@inner
def lay(splat, limits, box, state):
    """Lay a splat over what is there."""
    most, _, step = limits
    fall, gain, floor = splat[col.FALL_X], splat[col.GAIN], splat[col.FLOOR]
    rows = trace(splat, box, state)
    while rows != 0:
        r = lowest(rows)
        rows &= rows - 1
        column, end, ridge, peak = state[BEGIN + r], state[END + r], state[RIDGE + r], state[CREST + r]
        at = r * STRIDE + int(column)
        while column <= end:
            u = ramp(column - ridge)
            power = fma(u * u, -fall, peak)
            alpha = select(power >= LOG_MIN_ALPHA, minimum(fma(exp2(power), gain, 0 - floor), most), 0)
            blend(alpha, splat[col.RED], step, at, state)
            blend(alpha, splat[col.GREEN], step, PLANE + at, state)
            blend(alpha, splat[col.BLUE], step, 2 * PLANE + at, state)
            column += WIDTH
            at += WIDTH


@inner
def blend(alpha, color, step, at, state):
    """One channel of 16 pixels, within 0..1."""
    before = load(state, at)
    light = minimum(alpha * color, 1)
    after = (fma(1 - alpha, before, light) * (1 / step) + ROUNDER - ROUNDER) * step
    store(state, at, select(alpha > 0, minimum(maximum(after, 0), 1), before))
