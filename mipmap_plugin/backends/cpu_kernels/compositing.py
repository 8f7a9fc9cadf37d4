"""Front-to-back "over" inside tiles, forward and backward: splat by splat, over the rows of its ellipse, 16 pixels at a time.

A tile's pixels lie in planes of TILE_ROWS rows, each WIDTH longer than the tile, so that no run of 16 lanes needs an end of its own.
"""

import math

import numba
import numpy as np

from mipmap_plugin.backends.cpu_kernels.binning import TILE_COLUMNS, TILE_ROWS, half_width, rows_of, tile_grid
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, any_of, both, exp2, fma, load, minimum, ramp, select, spread, store, total
from mipmap_plugin.backends.cpu_kernels.records import (
    BLUE, FALL_X, FALL_Y, GREEN, LOG_MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE, PEAK, PULLS, RED, SHEAR,
    SUM, SUM_U, SUM_UU, SUM_UY, SUM_Y, SUM_YY, X, Y,
)  # fmt: skip

STRIDE = TILE_COLUMNS + WIDTH
PLANE = TILE_ROWS * STRIDE

# Splats between two looks at whether the tile is finished.
PATIENCE = 16


@numba.njit(cache=True)
def bounds(tile, width, height):
    """Left, top, columns and rows of a tile, px."""
    across, _ = tile_grid(width, height)
    left, top = tile % across * TILE_COLUMNS, tile // across * TILE_ROWS
    return left, top, min(TILE_COLUMNS, width - left), min(TILE_ROWS, height - top)


@numba.njit(cache=True)
def run_of(table, i, box, r):
    """Where splat i crosses row r of a tile: first and last column, the ridge's column, and log2 alpha on the ridge."""
    left, top, columns, _ = box
    dy = top + r + 0.5 - table[i, Y]
    ridge = table[i, X] + table[i, SHEAR] * dy - left - 0.5
    half = half_width(table, i, dy)
    first, last = math.ceil(max(ridge - half, 0.0)), math.floor(min(ridge + half, columns - 1.0))
    return int(min(first, TILE_COLUMNS)), int(max(last, -1.0)), ridge, table[i, PEAK] - table[i, FALL_Y] * dy * dy


@numba.njit(cache=True, nogil=True, error_model="numpy")
def composite(start, stop, table, starts, members, background, image, through, stops):
    """Render the tiles start..stop: image [H, W, 3], transmittance [H, W] and, at each pixel, its place in the list when it stopped."""
    height, width = through.shape
    red, green, blue, light, ends = np.empty(PLANE, np.float32), np.empty(PLANE, np.float32), np.empty(PLANE, np.float32), np.empty(PLANE, np.float32), np.empty(PLANE, np.float32)
    for tile in range(start, stop):
        box = bounds(tile, width, height)
        left, top, columns, rows = box
        red[:], green[:], blue[:], ends[:] = 0, 0, 0, starts[tile + 1] - starts[tile]
        light[:] = -1  # below 0: stopped
        for r in range(rows):
            light[r * STRIDE : r * STRIDE + columns] = 1
        for n in range(starts[tile + 1] - starts[tile]):
            if n % PATIENCE == 0 and finished(light, rows):
                break
            blend(table, members[starts[tile] + n], n, box, red, green, blue, light, ends)
        for r in range(rows):
            for c in range(columns):
                at = r * STRIDE + c
                rest = abs(light[at])
                image[top + r, left + c, 0] = red[at] + rest * background[0]
                image[top + r, left + c, 1] = green[at] + rest * background[1]
                image[top + r, left + c, 2] = blue[at] + rest * background[2]
                through[top + r, left + c] = rest
                stops[top + r, left + c] = ends[at]


@numba.njit(cache=True)
def finished(light, rows):
    for at in range(0, rows * STRIDE, WIDTH):
        if any_of(load(light, at) >= 0):
            return False
    return True


@numba.njit(cache=True)
def blend(table, i, n, box, red, green, blue, light, ends):
    """Lay splat i, the n-th of its tile, over what is there."""
    first, last = rows_of(table, i, box[1], box[1] + box[3] - 1)
    fall, r, g, b = table[i, FALL_X], table[i, RED], table[i, GREEN], table[i, BLUE]
    for row in range(first - box[1], last - box[1] + 1):
        begin, end, ridge, peak = run_of(table, i, box, row)
        for column in range(begin, end + 1, WIDTH):
            at = row * STRIDE + column
            u = ramp(column - ridge)
            power = fma(u * u, -fall, peak)
            alpha = minimum(exp2(power), MAX_ALPHA)
            before = load(light, at)
            after = before * (1 - alpha)
            bright = power >= LOG_MIN_ALPHA
            shown = both(bright, after >= MIN_TRANSMITTANCE)
            stopping = both(both(bright, before >= MIN_TRANSMITTANCE), after < MIN_TRANSMITTANCE)
            weight = select(shown, before * alpha, 0)
            store(red, at, fma(weight, r, load(red, at)))
            store(green, at, fma(weight, g, load(green, at)))
            store(blue, at, fma(weight, b, load(blue, at)))
            store(light, at, select(shown, after, select(stopping, 0 - before, before)))
            if any_of(stopping):
                store(ends, at, select(stopping, n, load(ends, at)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def composite_back(start, stop, table, starts, members, slots, background, through, stops, d_image, d_alpha, pulls):
    """Walk the lists of the tiles start..stop back to front and write each splat's pull in each tile into its slot."""
    height, width = through.shape
    planes = np.empty((6, PLANE), np.float32)
    for tile in range(start, stop):
        box = bounds(tile, width, height)
        used = begin_back(box, background, through, stops, d_image, d_alpha, planes)
        for n in range(used, starts[tile + 1] - starts[tile]):
            pulls[slots[starts[tile] + n]] = 0
        for n in range(used - 1, -1, -1):
            at = starts[tile] + n
            unblend(table, members[at], n, box, planes[0], planes[1], planes[2], planes[3], planes[4], planes[5], pulls[slots[at]])


@numba.njit(cache=True)
def begin_back(box, background, through, stops, d_image, d_alpha, planes):
    """Load a tile: dLoss/dimage, the final transmittance, what lies behind (dotted with dLoss/dimage), where pixels stopped."""
    left, top, columns, rows = box
    planes[:] = 0
    planes[3] = 1
    used = 0
    for r in range(rows):
        for c in range(columns):
            at, y, x = r * STRIDE + c, top + r, left + c
            red, green, blue = d_image[y, x, 0], d_image[y, x, 1], d_image[y, x, 2]
            planes[0, at], planes[1, at], planes[2, at], planes[3, at] = red, green, blue, through[y, x]
            planes[4, at] = background[0] * red + background[1] * green + background[2] * blue - d_alpha[y, x]
            planes[5, at] = stops[y, x]
            used = max(used, int(stops[y, x]))
    return used


@numba.njit(cache=True)
def unblend(table, i, n, box, red, green, blue, light, behind, ends, pull):
    """Take splat i off again and write its pull."""
    first, last = rows_of(table, i, box[1], box[1] + box[3] - 1)
    fall, r, g, b = table[i, FALL_X], table[i, RED], table[i, GREEN], table[i, BLUE]
    zero = spread(0)
    sum_, sum_u, sum_y, sum_uu, sum_uy, sum_yy, sum_r, sum_g, sum_b = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for row in range(first - box[1], last - box[1] + 1):
        begin, end, ridge, peak = run_of(table, i, box, row)
        dy = box[1] + row + 0.5 - table[i, Y]
        for column in range(begin, end + 1, WIDTH):
            at = row * STRIDE + column
            u = ramp(column - ridge)
            power = fma(u * u, -fall, peak)
            raw = exp2(power)
            shown = both(power >= LOG_MIN_ALPHA, n < load(ends, at))
            alpha = select(shown, minimum(raw, MAX_ALPHA), 0)
            before = load(light, at) / (1 - alpha)
            d_red, d_green, d_blue = load(red, at), load(green, at), load(blue, at)
            gain = fma(d_red, r, fma(d_green, g, d_blue * b)) - load(behind, at)
            weight = before * alpha
            store(light, at, before)
            store(behind, at, fma(alpha, gain, load(behind, at)))
            s = select(raw < MAX_ALPHA, weight * gain, 0)
            s_u, s_y = s * u, s * dy
            sum_, sum_u, sum_y = sum_ + s, sum_u + s_u, sum_y + s_y
            sum_uu, sum_uy, sum_yy = fma(s_u, u, sum_uu), fma(s_u, dy, sum_uy), fma(s_y, dy, sum_yy)
            sum_r, sum_g, sum_b = fma(weight, d_red, sum_r), fma(weight, d_green, sum_g), fma(weight, d_blue, sum_b)
    pull[SUM], pull[SUM_U], pull[SUM_Y] = total(sum_), total(sum_u), total(sum_y)
    pull[SUM_UU], pull[SUM_UY], pull[SUM_YY] = total(sum_uu), total(sum_uy), total(sum_yy)
    pull[RED], pull[GREEN], pull[BLUE] = total(sum_r), total(sum_g), total(sum_b)
