"""Which tiles a part of 16 splats touches: exact for the pixel rows and the extent in x of the ellipse alpha >= 1/255."""

# numba redefines calls and operators.
# mypy: ignore-errors

import math

from mipmap_plugin.backends.cpu_kernels import inner, kernel, layout
from mipmap_plugin.backends.cpu_kernels.blocks import get_part, put
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, bits, both, ceil, floor, lowest_bit, maximum, minimum, narrow, select, sqrt, wide
from mipmap_plugin.render_settings import MIN_ALPHA

# px. Tiles are wide so that splats touch few of them; what lies outside an ellipse costs little, since a splat visits only the patches of
# 4 x 4 px that it touches (`planes`). There are 64 of those, the bits of an integer. A tile's state fits a first-level cache.
TILE_HEIGHT = 16
TILE_WIDTH = 64

# px. Pixels this close to the outside of a splat's ellipse are visited too, so that rounding loses no pixel that passes the alpha test.
SLACK = 0.01

LOG_MIN_ALPHA = math.log2(MIN_ALPHA)


@kernel
def tile_grid(width, height):
    """The number of tiles in x and in y."""
    return -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)


@inner
def pixel_rows(block, height):
    """The first and last pixel row that each splat touches; if it touches none, the last is less than the first."""
    y, reach = wide(get_part(block, layout.Y)) - 0.5, wide(get_part(block, layout.REACH_Y)) + SLACK
    return integers_between(y - reach, y + reach, height - 1)


@inner
def integers_between(low, high, last):
    """The first and last integer of 0..last between two floats; if there is none, the last is less than the first."""
    return ceil(minimum(maximum(low, 0), last + 1)), floor(maximum(minimum(high, last), -1))


@inner
def half_width(block, dy):
    """px from the ellipse's center line to where alpha falls below 1/255, `dy` px from the center."""
    margin = wide(get_part(block, layout.PEAK)) - LOG_MIN_ALPHA - wide(get_part(block, layout.FALL_Y)) * dy * dy
    return wide(sqrt(narrow(maximum(margin, 0)) * get_part(block, layout.PER_FALL_X))) + SLACK


@inner
def tile_x_range(block, first, last, width):
    """The first and last tile in x that each splat touches between the pixel rows first..last; none: the last is less than the first."""
    y, rightmost_dy = wide(get_part(block, layout.Y)), wide(get_part(block, layout.RIGHTMOST_DY))
    x, shear = wide(get_part(block, layout.X)) - 0.5, wide(get_part(block, layout.SHEAR))
    above, below = first + 0.5 - y, last + 0.5 - y
    dy_of_right, dy_of_left = minimum(maximum(rightmost_dy, above), below), minimum(maximum(-rightmost_dy, above), below)
    right = x + shear * dy_of_right + half_width(block, dy_of_right)
    left = x + shear * dy_of_left - half_width(block, dy_of_left)
    low, high = integers_between(left, right, width - 1)
    touched = low <= high
    return select(touched, floor(low * (1 / TILE_WIDTH)), 0), select(touched, floor(high * (1 / TILE_WIDTH)), -1)


@inner
def tiles_in_row(first, last, tile_y, block, width):
    """For splats that touch the pixel rows first..last: which of them touch the tile row `tile_y`, and their first and last tile in it."""
    first_x, last_x = tile_x_range(block, maximum(first, tile_y * TILE_HEIGHT), minimum(last, tile_y * TILE_HEIGHT + (TILE_HEIGHT - 1)), width)
    return both(both(tile_y * TILE_HEIGHT <= last, first <= last), first_x <= last_x), first_x, last_x


@inner
def count_tiles(block, drawn, width, height):
    """The number of tiles that each splat touches, 0 for splats that are not drawn, and the first of them."""
    tiles_x = tile_grid(width, height)[0]
    first, last = pixel_rows(block, height)
    tile_y, count, first_tile = floor(first * (1 / TILE_HEIGHT)), first * 0, first * 0
    while bits(both(drawn, both(tile_y * TILE_HEIGHT <= last, first <= last))) != 0:
        touching, first_x, last_x = tiles_in_row(first, last, tile_y, block, width)
        first_tile = select(both(touching, count < 1), tile_y * tiles_x + first_x, first_tile)
        count = count + select(touching, last_x - first_x + 1, 0)
        tile_y = tile_y + 1
    return select(drawn, count, 0), first_tile


@inner
def write_tiles(block, spans, drawn, slots, width, height, tiles, counts):
    """Write the tiles of the splats whose bit is set in `drawn`, from their next `slots` on, and count them per tile. spans: two fields."""
    tiles_x = tile_grid(width, height)[0]
    first, last = pixel_rows(block, height)
    tile_y = floor(first * (1 / TILE_HEIGHT))
    while bits(both(tile_y * TILE_HEIGHT <= last, first <= last)) & drawn != 0:
        touching, first_x, last_x = tiles_in_row(first, last, tile_y, block, width)
        put(spans, 0, tile_y * tiles_x + first_x)
        put(spans, 1, tile_y * tiles_x + last_x)
        remaining = bits(touching) & drawn
        while remaining != 0:
            lane = lowest_bit(remaining)
            remaining &= remaining - 1
            for tile in range(int(spans[lane]), int(spans[WIDTH + lane]) + 1):
                tiles[slots[lane]] = tile
                counts[tile] += 1
                slots[lane] += 1
        tile_y = tile_y + 1
