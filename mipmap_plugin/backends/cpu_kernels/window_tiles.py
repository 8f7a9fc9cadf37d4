"""Front-to-back compositing through windows, and its gradients: as `compositing`, but alpha depends on the splats in front.

Unlike transmittance, windows cannot be recomputed back to front. So the backward pass first repeats the forward pass and stores the
windows before each visit.
"""

# numba redefines calls and operators.
# mypy: ignore-errors

import numpy as np
from numba import types

from mipmap_plugin.backends.cpu_kernels import inner, kernel, layout, windows
from mipmap_plugin.backends.cpu_kernels.binning import LOG_MIN_ALPHA
from mipmap_plugin.backends.cpu_kernels.compositing import fill_range, init_tile, tile_box, unfinished_patches, write_tile
from mipmap_plugin.backends.cpu_kernels.compositing_back import init_tile_back, write_sums
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, bits, both, lowest_bit, select
from mipmap_plugin.backends.cpu_kernels.memory import load, pointer, row_of, scratch, store
from mipmap_plugin.backends.cpu_kernels.patches import BATCH, find_patches, new_found
from mipmap_plugin.backends.cpu_kernels.planes import PATCHES, PLANE, STATE_SIZE, STOPS, TRANSMITTANCE, blend, distances, unblend
from mipmap_plugin.backends.cpu_kernels.sorting import sort
from mipmap_plugin.backends.cpu_kernels.sums import summed, summed_product, zero_sum
from mipmap_plugin.render_settings import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

USUAL_LIMITS = (MAX_ALPHA, MIN_TRANSMITTANCE, 0.0)

# The offset of four more planes in a tile's state: the windows' x, y, width and height; in the backward pass their gradients.
WINDOWS = STATE_SIZE
WINDOW_STATE_SIZE = STATE_SIZE + 4 * PLANE
new_window_state = scratch(WINDOW_STATE_SIZE, types.float32)

# A visit blends one splat into a patch. The backward pass stores VISIT_SIZE numbers per visit, the windows before it.
VISIT_SIZE = 4 * WIDTH


@kernel
def composite(start, stop, table, lists, frame, outputs):
    """Render the tiles start..stop into `frame`, and into the outputs: image [H, W, 3] and alpha [H, W]."""
    sort(start, stop, lists)
    starts, members, patches = lists.starts, pointer(lists.members), pointer(lists.patches)
    _, transmittance, _ = frame
    height, width = transmittance.shape
    state, found, no_record = new_window_state(), new_found(), (pointer(table), pointer(starts), False)
    for tile in range(start, stop):
        box, first = tile_box(tile, width, height), starts[tile]
        length = starts[tile + 1] - first
        init_windows(box, length, state)
        for begin in range(0, length, BATCH):
            unfinished = unfinished_patches(state)
            if unfinished == 0:
                break
            end = min(begin + BATCH, length)
            find_patches(table, members, patches, first + begin, first + end, box, found)
            for n in range(begin, end):
                draw_splat(row_of(table, members[first + n]), patches[first + n] & unfinished, n, box, state, no_record, 0)
        write_tile(box, state, frame, outputs)


@inner
def init_windows(box, length, state):
    """Clear the state. Each window is at first its pixel."""
    init_tile(box, length, state)
    fill_range(state, WINDOWS, WINDOWS + 2 * PLANE, 0)
    fill_range(state, WINDOWS + 2 * PLANE, WINDOW_STATE_SIZE, 1)


@inner
def load_windows(state, at, stride):
    return load(state, at), load(state, at + stride), load(state, at + 2 * stride), load(state, at + 3 * stride)


@inner
def store_windows(state, at, stride, window):
    store(state, at, window[0])
    store(state, at + stride, window[1])
    store(state, at + 2 * stride, window[2])
    store(state, at + 3 * stride, window[3])


@inner
def select_windows(mask, yes, no):
    """`select`, for windows."""
    return select(mask, yes[0], no[0]), select(mask, yes[1], no[1]), select(mask, yes[2], no[2]), select(mask, yes[3], no[3])


@inner
def draw_pixels(shape, margin, dx, dy, open_pixels, color, n, at, state, record, visits):
    """Blend a splat into the 16 pixels at `at`, seen through their windows. Returns the number of visits, 0 or 1."""
    window = load_windows(state, WINDOWS + at, PLANE)
    if bits(both(open_pixels, windows.may_reach(shape, margin, dx, dy, window))) == 0:
        return 0
    alpha, integral = windows.integrate(shape, dx, dy, window)
    bright = both(alpha >= MIN_ALPHA, open_pixels)
    if bits(bright) == 0:
        return 0
    stored, positions, keeps = record
    if keeps:
        store_windows(stored, visits * VISIT_SIZE, WIDTH, window)
        positions[visits] = at
    blend(alpha, bright, USUAL_LIMITS, color, n, at, state)
    after = windows.clamp_window(windows.windows_behind(shape, window, alpha, integral)[0])
    store_windows(state, WINDOWS + at, PLANE, select_windows(bright, after, window))
    return 1


@inner
def draw_splat(splat, patches, n, box, state, record, visits):
    """Blend a splat, the n-th of its tile, behind those already blended; returns the number of visits so far.

    record: where the windows before each visit are stored, where its patch, and whether to store them.
    """
    color, shape = (splat[layout.RED], splat[layout.GREEN], splat[layout.BLUE]), windows.splat_parameters(splat)
    margin = splat[layout.PEAK] - LOG_MIN_ALPHA
    while patches != 0:
        patch = lowest_bit(patches)
        patches &= patches - 1
        open_pixels = load(state, TRANSMITTANCE + patch * WIDTH) >= 0
        if bits(open_pixels) != 0:
            dx, dy = distances(splat, patch, box)
            visits += draw_pixels(shape, margin, dx, dy, open_pixels, color, n, patch * WIDTH, state, record, visits)
    return visits


@kernel
def composite_back(start, stop, table, lists, frame, d_outputs, tile_grads):
    """Walk the lists of the tiles start..stop back to front and write each splat's gradients in each tile to its slot.

    d_outputs: the gradients of the image [H, W, 3] and of its alpha [H, W].
    """
    starts, members, slots, patches = lists.starts, pointer(lists.members), lists.slots, pointer(lists.patches)
    background, transmittance, stops = frame
    d_image, d_alpha = d_outputs
    height, width = transmittance.shape
    state = new_window_state()
    stored, positions = np.empty(BATCH * PATCHES * VISIT_SIZE, np.float32), np.empty(BATCH * PATCHES, np.int64)
    for tile in range(start, stop):
        box, first = tile_box(tile, width, height), starts[tile]
        length = starts[tile + 1] - first
        visit_offsets, visits = np.zeros(length + 1, np.int64), 0
        init_windows(box, length, state)
        for begin in range(0, length, BATCH):
            unfinished = unfinished_patches(state)
            if unfinished == 0:
                break
            if visits + BATCH * PATCHES > len(positions):
                stored, positions = np.append(stored, np.empty_like(stored)), np.append(positions, np.empty_like(positions))
            record, end = (pointer(stored), pointer(positions), True), min(begin + BATCH, length)
            for n in range(begin, end):
                visits = draw_splat(row_of(table, members[first + n]), patches[first + n] & unfinished, n, box, state, record, visits)
                visit_offsets[n + 1] = visits

        used = init_tile_back(box, background, transmittance, stops, d_image, d_alpha, state)
        fill_range(state, WINDOWS, WINDOW_STATE_SIZE, 0)
        for at in range(first + used, starts[tile + 1]):
            for k in range(layout.GRADS):
                tile_grads[slots[at], k] = 0
        for n in range(used - 1, -1, -1):
            splat, grads = row_of(table, members[first + n]), row_of(tile_grads, slots[first + n])
            undraw_splat(splat, n, box, state, record, (visit_offsets[n], visit_offsets[n + 1]), grads)


@inner
def undraw_splat(splat, n, box, state, record, visits, grads):
    """Remove a splat, the n-th of its tile, and write its gradients. visits: the first of its visits, and the first of the next splat's."""
    stored, positions, _ = record
    color, shape = (splat[layout.RED], splat[layout.GREEN], splat[layout.BLUE]), windows.splat_parameters(splat)
    sum_1 = sum_u = sum_v = sum_log_long = sum_log_short = sum_angle = sum_red = sum_green = sum_blue = zero_sum()
    for visit in range(visits[0], visits[1]):
        at, window = positions[visit], load_windows(stored, visit * VISIT_SIZE, WIDTH)
        dx, dy = distances(splat, at // WIDTH, box)
        alpha, integral = windows.integrate(shape, dx, dy, window)
        bright = alpha >= MIN_ALPHA
        visible = both(bright, n < load(state, STOPS + at))
        s, _, weight, d_red, d_green, d_blue = unblend(alpha, bright, USUAL_LIMITS, color, n, at, state)
        after, behind = windows.windows_behind(shape, window, alpha, integral)
        d_window = load_windows(state, WINDOWS + at, PLANE)
        d_before, s, slopes = windows.grad_windows_behind(shape, alpha, s, integral, behind, windows.grad_clamp_window(after, d_window))
        store_windows(state, WINDOWS + at, PLANE, select_windows(visible, d_before, d_window))
        sum_1, sum_angle = summed(sum_1, select(visible, s, 0)), summed(sum_angle, select(visible, slopes[4], 0))
        sum_u, sum_v = summed(sum_u, select(visible, slopes[0], 0)), summed(sum_v, select(visible, slopes[1], 0))
        sum_log_long = summed(sum_log_long, select(visible, slopes[2], 0))
        sum_log_short = summed(sum_log_short, select(visible, slopes[3], 0))
        sum_red, sum_green = summed_product(sum_red, weight, d_red), summed_product(sum_green, weight, d_green)
        sum_blue = summed_product(sum_blue, weight, d_blue)
    sum_u, sum_v = sum_u * (1 / shape[3]), sum_v * (1 / shape[4])
    write_sums((sum_1, sum_u, sum_v, sum_log_long, sum_log_short, sum_angle, sum_red, sum_green), sum_blue, grads)
