"""The backward pass of `compositing`: back to front, each splat is removed from the pixels and gets its gradients."""

# numba redefines calls and operators.
# mypy: ignore-errors

from mipmap_plugin.backends.cpu_kernels import inner, integrals, kernel, layout
from mipmap_plugin.backends.cpu_kernels.compositing import alpha_of, fill_range, tile_box
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, bits, fma, lowest_bit
from mipmap_plugin.backends.cpu_kernels.memory import load, pointer, row_of, store
from mipmap_plugin.backends.cpu_kernels.patches import BATCH, prefetch_rows
from mipmap_plugin.backends.cpu_kernels.planes import (
    BEHIND_DOT_GRAD,
    PATCH,
    PATCHES,
    PLANE,
    STATE_SIZE,
    STOPS,
    TRANSMITTANCE,
    distances,
    grad_culled,
    new_state,
    offset_of,
    unblend,
)
from mipmap_plugin.backends.cpu_kernels.sums import summed, summed_product, total, totals, zero_sum
from mipmap_plugin.render_settings import MIN_ALPHA


@kernel
def composite_back(start, stop, integrated, reshaped, faded, limits, table, lists, frame, d_outputs, tile_grads):
    """Walk the lists of the tiles start..stop back to front and write each splat's gradients in each tile to its slot.

    d_outputs: the gradients of the image [H, W, 3] and of its alpha [H, W].
    """
    starts, members, slots, patches = lists.starts, lists.members, lists.slots, pointer(lists.patches)
    background, transmittance, stops = frame
    d_image, d_alpha = d_outputs
    height, width = transmittance.shape
    state = new_state()
    for tile in range(start, stop):
        box, first = tile_box(tile, width, height), starts[tile]
        used = init_tile_back(box, background, transmittance, stops, d_image, d_alpha, state)
        for at in range(first + used, starts[tile + 1]):
            for k in range(layout.GRADS):
                tile_grads[slots[at], k] = 0
        for end in range(used, 0, -BATCH):
            begin = max(end - BATCH, 0)
            prefetch_rows(table, members, first + max(begin - BATCH, 0), first + begin)
            prefetch_rows(tile_grads, slots, first + max(begin - BATCH, 0), first + begin)
            begun = begun_patches(begin, state)
            for n in range(end - 1, begin - 1, -1):
                splat, grads = row_of(table, members[first + n]), row_of(tile_grads, slots[first + n])
                if integrated is not None:
                    undraw_integral(splat, limits, patches[first + n] & begun, n, box, state, grads)
                else:
                    undraw_at_center(splat, limits, reshaped, faded, patches[first + n] & begun, n, box, state, grads)


@inner
def begun_patches(n, state):
    """A bit per patch of which some pixel was not stopped by the n-th splat of the tile or one before it."""
    patches = 0
    for patch in range(PATCHES):
        if bits(load(state, STOPS + patch * WIDTH) > n) != 0:
            patches |= 1 << patch
    return patches


@inner
def undraw_at_center(splat, limits, reshaped, faded, patches, n, box, state, grads):
    """Remove a splat that is sampled at pixel centers, as it is drawn. reshaped, faded: as of `records.Flags`."""
    if reshaped is not None and splat[layout.GATE] == 0:
        undraw_culled(splat, patches, n, box, state, grads)
    elif faded is not None and splat[layout.OFFSET] > 0:
        undraw_splat(splat, limits, True, patches, n, box, state, grads)
    else:
        undraw_splat(splat, limits, False, patches, n, box, state, grads)


@inner
def init_tile_back(box, background, transmittance, stops, d_image, d_alpha, state):
    """Restore the final state of a tile; returns how many of its splats were blended."""
    left, top, tile_width, tile_height = box
    width = transmittance.shape[1]
    d_colors, d_alphas, transmittances, stop_list = pointer(d_image), pointer(d_alpha), pointer(transmittance), pointer(stops)
    fill_range(state, 0, STATE_SIZE, 0)
    fill_range(state, TRANSMITTANCE, STOPS, 1)
    last = background[0] * 0
    for r in range(tile_height):
        for c in range(tile_width):
            at, pixel = offset_of(r, c - c % PATCH) + c % PATCH, (top + r) * width + left + c
            behind = -d_alphas[pixel]
            for k in range(3):
                state[k * PLANE + at] = d_colors[3 * pixel + k]
                behind += background[k] * d_colors[3 * pixel + k]
            state[TRANSMITTANCE + at], state[STOPS + at], state[BEHIND_DOT_GRAD + at] = transmittances[pixel], stop_list[pixel], behind
            last = max(last, stop_list[pixel])
    return int(last)


@inner
def undraw_splat(splat, limits, fades, patches, n, box, state, grads):
    """Remove a splat, the n-th of its tile, from `patches`, and write its gradients.

    fades: a compile-time constant, so that splats that do not fade skip the extra work.
    """
    offset, color = splat[layout.OFFSET], (splat[layout.RED], splat[layout.GREEN], splat[layout.BLUE])
    sum_1 = sum_u = sum_y = sum_uu = sum_uy = sum_yy = sum_red = sum_green = sum_blue = zero_sum()
    while patches != 0:
        patch = lowest_bit(patches)
        patches &= patches - 1
        dx, dy = distances(splat, patch, box)
        (alpha, bright), u = alpha_of(splat, None, dx, dy), fma(dy, 0 - splat[layout.SHEAR], dx)
        s, d_alpha, weight, d_red, d_green, d_blue = unblend(alpha, bright, limits, color, n, patch * WIDTH, state)
        sum_1 = summed(sum_1, s)
        if fades:
            s = fma(d_alpha, offset, s)  # the offset does not depend on the shape
        s_u, s_y = s * u, s * dy
        sum_u, sum_y = summed(sum_u, s_u), summed(sum_y, s_y)
        sum_uu, sum_uy, sum_yy = summed_product(sum_uu, s_u, u), summed_product(sum_uy, s_u, dy), summed_product(sum_yy, s_y, dy)
        sum_red, sum_green = summed_product(sum_red, weight, d_red), summed_product(sum_green, weight, d_green)
        sum_blue = summed_product(sum_blue, weight, d_blue)
    write_sums((sum_1, sum_u, sum_y, sum_uu, sum_uy, sum_yy, sum_red, sum_green), sum_blue, grads)


@inner
def write_sums(sums, last, grads):
    """Write a splat's row of the gradient table: the totals of 8 sums, and of the last."""
    store(grads, 0, totals(sums))
    grads[layout.GRADS - 1] = total(last)


@inner
def undraw_culled(splat, patches, n, box, state, grads):
    """Write the gradient of a culled splat, which only its gate has."""
    color, sum_1 = (splat[layout.RED], splat[layout.GREEN], splat[layout.BLUE]), zero_sum()
    while patches != 0:
        patch = lowest_bit(patches)
        patches &= patches - 1
        alpha, bright = alpha_of(splat, None, *distances(splat, patch, box))
        sum_1 = summed(sum_1, grad_culled(alpha, bright, color, n, patch * WIDTH, state))
    for k in range(layout.GRADS):
        grads[k] = 0
    grads[layout.SUM] = total(sum_1)


@inner
def undraw_integral(splat, limits, patches, n, box, state, grads):
    """As `undraw_splat`, for a splat that is integrated over pixels."""
    color = splat[layout.RED], splat[layout.GREEN], splat[layout.BLUE]
    sum_1 = sum_u = sum_v = sum_log_long = sum_log_short = sum_angle = sum_red = sum_green = sum_blue = zero_sum()
    while patches != 0:
        patch = lowest_bit(patches)
        patches &= patches - 1
        alpha, by_u, by_v, by_log_long, by_log_short, by_angle = integrals.alpha_slopes(splat, *distances(splat, patch, box))
        s, _, weight, d_red, d_green, d_blue = unblend(alpha, alpha >= MIN_ALPHA, limits, color, n, patch * WIDTH, state)
        sum_1, sum_u, sum_v = summed(sum_1, s), summed_product(sum_u, s, by_u), summed_product(sum_v, s, by_v)
        sum_log_long, sum_log_short = summed_product(sum_log_long, s, by_log_long), summed_product(sum_log_short, s, by_log_short)
        sum_angle = summed_product(sum_angle, s, by_angle)
        sum_red, sum_green = summed_product(sum_red, weight, d_red), summed_product(sum_green, weight, d_green)
        sum_blue = summed_product(sum_blue, weight, d_blue)
    write_sums((sum_1, sum_u, sum_v, sum_log_long, sum_log_short, sum_angle, sum_red, sum_green), sum_blue, grads)
