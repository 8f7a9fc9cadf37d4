"""Pictures of few bits: the image again, back to front, rounded after each splat. The gradient remains that of the unrounded image."""

# numba redefines calls and operators.
# mypy: ignore-errors

from mipmap_plugin.backends.cpu_kernels import inner, kernel, layout
from mipmap_plugin.backends.cpu_kernels.binning import LOG_MIN_ALPHA
from mipmap_plugin.backends.cpu_kernels.compositing import PREFETCH_AHEAD, fill_range, new_state, outline_rows, tile_box
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, fma, lowest_bit, maximum, minimum, ramp, select
from mipmap_plugin.backends.cpu_kernels.memory import load, prefetch, row_of, store
from mipmap_plugin.backends.cpu_kernels.planes import PLANE, ROW_BEGIN, ROW_CENTER, ROW_END, ROW_PEAK, STRIDE
from mipmap_plugin.backends.cpu_kernels.powers import exp2

# 1.5 · 2^23: adding it to a float32 and subtracting it again rounds to the nearest integer.
ROUNDER = 12582912.0


@kernel
def composite(start, stop, limits, table, lists, frame, outputs):
    """Draw the image [H, W, 3] of the tiles start..stop again; `lists` are sorted."""
    starts, members, _, _ = lists
    background, transmittance, _ = frame
    image, _ = outputs
    height, width = transmittance.shape
    state = new_state()
    for tile in range(start, stop):
        box = tile_box(tile, width, height)
        left, top, tile_width, tile_height = box
        for k in range(3):
            fill_range(state, k * PLANE, (k + 1) * PLANE, background[k])
        for at in range(starts[tile + 1] - 1, starts[tile] - 1, -1):
            prefetch(table, members[max(at - PREFETCH_AHEAD, starts[tile])])
            splat = row_of(table, members[at])
            if splat[layout.GATE] > 0:
                draw_splat(splat, limits, box, state)
        for r in range(tile_height):
            for c in range(tile_width):
                for k in range(3):
                    image[top + r, left + c, k] = state[k * PLANE + r * STRIDE + c]


@inner
def draw_splat(splat, limits, box, state):
    """Blend a splat over those already blended."""
    max_alpha, _, step = limits
    fall, gain, offset = splat[layout.FALL_X], splat[layout.GAIN], splat[layout.OFFSET]
    rows = outline_rows(splat, box, state)
    while rows != 0:
        r = lowest_bit(rows)
        rows &= rows - 1
        x, end, center, peak = state[ROW_BEGIN + r], state[ROW_END + r], state[ROW_CENTER + r], state[ROW_PEAK + r]
        at = r * STRIDE + int(x)
        while x <= end:
            u = ramp(x - center)
            power = fma(u * u, -fall, peak)
            alpha = select(power >= LOG_MIN_ALPHA, minimum(fma(exp2(power), gain, 0 - offset), max_alpha), 0)
            blend_channel(alpha, splat[layout.RED], step, at, state)
            blend_channel(alpha, splat[layout.GREEN], step, PLANE + at, state)
            blend_channel(alpha, splat[layout.BLUE], step, 2 * PLANE + at, state)
            x += WIDTH
            at += WIDTH


@inner
def blend_channel(alpha, color, step, at, state):
    """Blend one channel of 16 pixels, rounded to multiples of `step` and clamped to 0..1."""
    before = load(state, at)
    added = minimum(alpha * color, 1)
    after = (fma(1 - alpha, before, added) * (1 / step) + ROUNDER - ROUNDER) * step
    store(state, at, select(alpha > 0, minimum(maximum(after, 0), 1), before))
