"""The backward pass of `compositing`: back to front, each splat is removed from the pixels and gets its gradients."""

# numba redefines calls and operators.
# mypy: ignore-errors

from mipmap_plugin.backends.cpu_kernels import inner, integrals, kernel, layout
from mipmap_plugin.backends.cpu_kernels.binning import LOG_MIN_ALPHA
from mipmap_plugin.backends.cpu_kernels.compositing import PREFETCH_AHEAD, fill_range, new_state, outline_rows, tile_box
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, broadcast, fma, lowest_bit, ramp, total
from mipmap_plugin.backends.cpu_kernels.memory import prefetch, row_of
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
    grad_culled,
    unblend,
)
from mipmap_plugin.backends.cpu_kernels.powers import exp2
from mipmap_plugin.effects import MIN_ALPHA


@kernel
def composite_back(start, stop, integrated, reshaped, faded, limits, table, lists, frame, d_outputs, tile_grads):
    """Walk the lists of the tiles start..stop back to front and write each splat's gradients in each tile to its slot.

    d_outputs: the gradients of the image [H, W, 3] and of its alpha [H, W].
    """
    starts, members, slots, _ = lists
    background, transmittance, stops = frame
    d_image, d_alpha = d_outputs
    height, width = transmittance.shape
    state = new_state()
    for tile in range(start, stop):
        box = tile_box(tile, width, height)
        used = init_tile_back(box, background, transmittance, stops, d_image, d_alpha, state)
        for at in range(starts[tile] + used, starts[tile + 1]):
            for k in range(layout.GRADS):
                tile_grads[slots[at], k] = 0
        for n in range(used - 1, -1, -1):
            at = starts[tile] + n
            prefetch(table, members[max(at - PREFETCH_AHEAD, 0)])
            splat, grads = row_of(table, members[at]), row_of(tile_grads, slots[at])
            if integrated is not None:
                undraw_integral(splat, limits, n, box, state, grads)
            else:
                undraw_at_center(splat, limits, reshaped, faded, n, box, state, grads)


@inner
def undraw_at_center(splat, limits, reshaped, faded, n, box, state, grads):
    """Remove a splat that is sampled at pixel centers, as it is drawn. reshaped, faded: as of `records.Flags`."""
    if reshaped is not None and splat[layout.GATE] == 0:
        undraw_culled(splat, n, box, state, grads)
    elif faded is not None and splat[layout.OFFSET] > 0:
        undraw_splat(splat, limits, True, n, box, state, grads)
    else:
        undraw_splat(splat, limits, False, n, box, state, grads)


@inner
def init_tile_back(box, background, transmittance, stops, d_image, d_alpha, state):
    """Restore the final state of a tile; returns how many of its splats were blended."""
    left, top, tile_width, tile_height = box
    fill_range(state, 0, STATE_SIZE, 0)
    fill_range(state, TRANSMITTANCE, STOPS, 1)
    used = 0
    for r in range(tile_height):
        for c in range(tile_width):
            at, y, x = r * STRIDE + c, top + r, left + c
            behind = -d_alpha[y, x]
            for k in range(3):
                state[k * PLANE + at] = d_image[y, x, k]
                behind += background[k] * d_image[y, x, k]
            state[TRANSMITTANCE + at], state[STOPS + at], state[BEHIND_DOT_GRAD + at] = transmittance[y, x], stops[y, x], behind
            used = max(used, int(stops[y, x]))
    return used


@inner
def undraw_splat(splat, limits, fades, n, box, state, grads):
    """Remove a splat, the n-th of its tile, and write its gradients.

    fades: a compile-time constant, so that splats that do not fade skip the extra work.
    """
    fall, gain, offset = splat[layout.FALL_X], splat[layout.GAIN], splat[layout.OFFSET]
    color = splat[layout.RED], splat[layout.GREEN], splat[layout.BLUE]
    sum_1 = sum_u = sum_y = sum_uu = sum_uy = sum_yy = sum_red = sum_green = sum_blue = broadcast(0)
    rows = outline_rows(splat, box, state)
    while rows != 0:
        r = lowest_bit(rows)
        rows &= rows - 1
        x, end, center, peak = state[ROW_BEGIN + r], state[ROW_END + r], state[ROW_CENTER + r], state[ROW_PEAK + r]
        at = r * STRIDE + int(x)
        dy = box[1] + r + 0.5 - splat[layout.Y]
        while x <= end:
            u = ramp(x - center)
            power = fma(u * u, -fall, peak)
            alpha = fma(exp2(power), gain, 0 - offset)
            s, d_alpha, weight, d_red, d_green, d_blue = unblend(alpha, power >= LOG_MIN_ALPHA, limits, color, n, at, state)
            sum_1 = sum_1 + s
            if fades:
                s = fma(d_alpha, offset, s)  # the offset does not depend on the shape
            s_u, s_y = s * u, s * dy
            sum_u, sum_y = sum_u + s_u, sum_y + s_y
            sum_uu, sum_uy, sum_yy = fma(s_u, u, sum_uu), fma(s_u, dy, sum_uy), fma(s_y, dy, sum_yy)
            sum_red, sum_green, sum_blue = fma(weight, d_red, sum_red), fma(weight, d_green, sum_green), fma(weight, d_blue, sum_blue)
            x += WIDTH
            at += WIDTH
    grads[layout.SUM], grads[layout.SUM_U], grads[layout.SUM_Y] = total(sum_1), total(sum_u), total(sum_y)
    grads[layout.SUM_UU], grads[layout.SUM_UY], grads[layout.SUM_YY] = total(sum_uu), total(sum_uy), total(sum_yy)
    grads[layout.GRAD_RED], grads[layout.GRAD_GREEN], grads[layout.GRAD_BLUE] = total(sum_red), total(sum_green), total(sum_blue)


@inner
def undraw_culled(splat, n, box, state, grads):
    """Write the gradient of a culled splat, which only its gate has."""
    fall, gain, offset = splat[layout.FALL_X], splat[layout.GAIN], splat[layout.OFFSET]
    color, sum_1 = (splat[layout.RED], splat[layout.GREEN], splat[layout.BLUE]), broadcast(0)
    rows = outline_rows(splat, box, state)
    while rows != 0:
        r = lowest_bit(rows)
        rows &= rows - 1
        x, end, center, peak = state[ROW_BEGIN + r], state[ROW_END + r], state[ROW_CENTER + r], state[ROW_PEAK + r]
        at = r * STRIDE + int(x)
        while x <= end:
            u = ramp(x - center)
            power = fma(u * u, -fall, peak)
            sum_1 = sum_1 + grad_culled(fma(exp2(power), gain, 0 - offset), power >= LOG_MIN_ALPHA, color, n, at, state)
            x += WIDTH
            at += WIDTH
    for k in range(layout.GRADS):
        grads[k] = 0
    grads[layout.SUM] = total(sum_1)


@inner
def undraw_integral(splat, limits, n, box, state, grads):
    """As `undraw_splat`, for a splat that is integrated over pixels."""
    color = splat[layout.RED], splat[layout.GREEN], splat[layout.BLUE]
    sum_1 = sum_u = sum_v = sum_log_long = sum_log_short = sum_angle = sum_red = sum_green = sum_blue = broadcast(0)
    rows = outline_rows(splat, box, state)
    while rows != 0:
        r = lowest_bit(rows)
        rows &= rows - 1
        x, end = state[ROW_BEGIN + r], state[ROW_END + r]
        at = r * STRIDE + int(x)
        center, dy = splat[layout.X] - box[0] - 0.5, box[1] + r + 0.5 - splat[layout.Y]
        while x <= end:
            alpha, by_u, by_v, by_log_long, by_log_short, by_angle = integrals.alpha_slopes(splat, ramp(x - center), dy)
            s, _, weight, d_red, d_green, d_blue = unblend(alpha, alpha >= MIN_ALPHA, limits, color, n, at, state)
            sum_1, sum_u, sum_v = sum_1 + s, fma(s, by_u, sum_u), fma(s, by_v, sum_v)
            sum_log_long, sum_log_short = fma(s, by_log_long, sum_log_long), fma(s, by_log_short, sum_log_short)
            sum_angle = fma(s, by_angle, sum_angle)
            sum_red, sum_green, sum_blue = fma(weight, d_red, sum_red), fma(weight, d_green, sum_green), fma(weight, d_blue, sum_blue)
            x += WIDTH
            at += WIDTH
    grads[layout.SUM], grads[layout.GRAD_U], grads[layout.GRAD_V] = total(sum_1), total(sum_u), total(sum_v)
    grads[layout.GRAD_LOG_LONG], grads[layout.GRAD_LOG_SHORT], grads[layout.GRAD_ANGLE] = total(sum_log_long), total(sum_log_short), total(sum_angle)
    grads[layout.GRAD_RED], grads[layout.GRAD_GREEN], grads[layout.GRAD_BLUE] = total(sum_red), total(sum_green), total(sum_blue)
