"""Which tiles a splat touches: exact at the rows and columns of the ellipse alpha >= 1/255."""

import math

from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels import inner, kernel
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH
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
def rows_of(table, i, first, last):
    """The pixel rows first..last that splat i touches."""
    reach = table[i, col.REACH_Y] + SLACK
    return within(table[i, col.Y] - 0.5 - reach, table[i, col.Y] - 0.5 + reach, first, last)


@inner
def within(low, high, first, last):
    """The integers of first..last that lie between two floats; none: the second is the smaller.

    Clipped while still floats, for compiled `ceil` and `floor` give 64-bit integers, which do not hold every reach.
    """
    return math.ceil(min(max(low, first), last + 1.0)), math.floor(max(min(high, last), first - 1.0))


@inner
def half_width(table, i, dy):
    """px from the ridge to where alpha falls below 1/255, `dy` px from the center."""
    room = table[i, col.PEAK] - LOG_MIN_ALPHA - table[i, col.FALL_Y] * dy * dy
    return math.sqrt(max(room, 0.0) * table[i, col.SPREAD]) + SLACK


@inner
def tile_columns(table, i, first, last, width):
    """The columns of tiles that splat i touches between the pixel rows first..last; none: the second is the smaller."""
    above, below = first + 0.5 - table[i, col.Y], last + 0.5 - table[i, col.Y]
    right_most = min(max(table[i, col.TIP], above), below)
    left_most = min(max(-table[i, col.TIP], above), below)
    right = table[i, col.X] + table[i, col.SHEAR] * right_most + half_width(table, i, right_most) - 0.5
    left = table[i, col.X] + table[i, col.SHEAR] * left_most - half_width(table, i, left_most) - 0.5
    low, high = within(left, right, 0, width - 1)
    if low > high:
        return 0, -1
    return low // TILE_COLUMNS, high // TILE_COLUMNS


@inner
def count_tiles(table, i, width, height):
    """The number of tiles that splat i touches."""
    first, last = rows_of(table, i, 0, height - 1)
    if first > last:
        return 0
    count = 0
    for tile_row in range(first // TILE_ROWS, last // TILE_ROWS + 1):
        top, bottom = max(first, tile_row * TILE_ROWS), min(last, tile_row * TILE_ROWS + TILE_ROWS - 1)
        left, right = tile_columns(table, i, top, bottom, width)
        count += right - left + 1
    return count


@inner
def cover(table, i, slot, width, height, tiles, counts, run):
    """Write the tiles of splat i into its slots, from `slot` on, and count them as those of a run."""
    columns = tile_grid(width, height)[0]
    first, last = rows_of(table, i, 0, height - 1)
    for tile_row in range(first // TILE_ROWS, last // TILE_ROWS + 1):
        top, bottom = max(first, tile_row * TILE_ROWS), min(last, tile_row * TILE_ROWS + TILE_ROWS - 1)
        left, right = tile_columns(table, i, top, bottom, width)
        for tile_column in range(left, right + 1):
            tile = tile_row * columns + tile_column
            tiles[slot] = tile
            counts[run, tile] += 1
            slot += 1
