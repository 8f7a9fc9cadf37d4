"""Which tiles 16 splats touch: exact at the rows and columns of the ellipse alpha >= 1/255."""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

import math

from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels import inner, kernel
from mipmap_plugin.backends.cpu_kernels.blocks import get, put
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, bits, both, ceil, floor, lowest, maximum, minimum, narrow, select, sqrt, wide
from mipmap_plugin.effects import MIN_ALPHA

# px. A row for each lane, to trace a splat through all of them at once; and wide: a splat is cut into few pieces, and where it
# crosses a row is exact anyway. A tile's state fits a first-level cache.
TILE_ROWS = WIDTH
TILE_COLUMNS = 64

# Rows and columns this close to a splat's edge are visited too: rounding must not lose a pixel that passes the alpha test.
SLACK = 0.01  # px

LOG_MIN_ALPHA = math.log2(MIN_ALPHA)


@kernel
def tile_grid(width, height):
    """Columns and rows of tiles."""
    return -(-width // TILE_COLUMNS), -(-height // TILE_ROWS)


@inner
def rows_of(block, height):
    """The first and last pixel row that each splat touches; none: the second is the smaller."""
    y, reach = wide(get(block, col.Y)) - 0.5, wide(get(block, col.REACH_Y)) + SLACK
    return within(y - reach, y + reach, height - 1)


@inner
def within(low, high, last):
    """The integers of 0..last that lie between two floats; none: the second is the smaller."""
    return ceil(minimum(maximum(low, 0), last + 1)), floor(maximum(minimum(high, last), -1))


@inner
def half_width(block, dy):
    """px from the ridge to where alpha falls below 1/255, `dy` px from the center."""
    room = wide(get(block, col.PEAK)) - LOG_MIN_ALPHA - wide(get(block, col.FALL_Y)) * dy * dy
    return wide(sqrt(narrow(maximum(room, 0)) * get(block, col.SPREAD))) + SLACK


@inner
def tile_columns(block, first, last, width):
    """The columns of tiles that each splat touches between the pixel rows first..last; none: the second is the smaller."""
    y, tip = wide(get(block, col.Y)), wide(get(block, col.TIP))
    x, shear = wide(get(block, col.X)) - 0.5, wide(get(block, col.SHEAR))
    above, below = first + 0.5 - y, last + 0.5 - y
    right_most, left_most = minimum(maximum(tip, above), below), minimum(maximum(-tip, above), below)
    right = x + shear * right_most + half_width(block, right_most)
    left = x + shear * left_most - half_width(block, left_most)
    low, high = within(left, right, width - 1)
    touched = low <= high
    return select(touched, floor(low * (1 / TILE_COLUMNS)), 0), select(touched, floor(high * (1 / TILE_COLUMNS)), -1)


@inner
def tile_row(first, last, row, block, width):
    """Which of 16 splats that touch the pixel rows first..last have tiles in their tile row `row`, and from which column to which."""
    left, right = tile_columns(block, maximum(first, row * TILE_ROWS), minimum(last, row * TILE_ROWS + (TILE_ROWS - 1)), width)
    return both(both(row * TILE_ROWS <= last, first <= last), left <= right), left, right


@inner
def count_tiles(block, drawn, width, height):
    """The number of tiles that each splat touches, those that are drawn."""
    first, last = rows_of(block, height)
    row, count = floor(first * (1 / TILE_ROWS)), first * 0
    while bits(both(drawn, both(row * TILE_ROWS <= last, first <= last))) != 0:
        touching, left, right = tile_row(first, last, row, block, width)
        count = count + select(touching, right - left + 1, 0)
        row = row + 1
    return select(drawn, count, 0)


@inner
def cover(block, spans, drawn, slots, width, height, tiles, counts):
    """Write the tiles of the splats whose bit is set in `drawn` into their slots, from `slots` [16] on, and count them. spans: [32]."""
    columns = tile_grid(width, height)[0]
    first, last = rows_of(block, height)
    row = floor(first * (1 / TILE_ROWS))
    while bits(both(row * TILE_ROWS <= last, first <= last)) & drawn != 0:
        touching, left, right = tile_row(first, last, row, block, width)
        put(spans, 0, row * columns + left)
        put(spans, 1, row * columns + right)
        todo = bits(touching) & drawn
        while todo != 0:
            lane = lowest(todo)
            todo &= todo - 1
            for tile in range(int(spans[lane]), int(spans[WIDTH + lane]) + 1):
                tiles[slots[lane]] = tile
                counts[tile] += 1
                slots[lane] += 1
        row = row + 1
