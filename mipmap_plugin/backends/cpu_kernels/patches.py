"""The patches of a tile that splats touch, for 16 splats of its list at a time. The forward pass finds them; the backward pass reads them again."""

# numba redefines calls and operators.
# mypy: ignore-errors

import numpy as np
from numba import types

from mipmap_plugin.backends.cpu_kernels import inner, layout
from mipmap_plugin.backends.cpu_kernels.binning import LOG_MIN_ALPHA, SLACK, TILE_HEIGHT
from mipmap_plugin.backends.cpu_kernels.columns import outlines
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, broadcast, ceil, floor, fma, maximum, minimum, select, sqrt
from mipmap_plugin.backends.cpu_kernels.memory import prefetch, scratch, store_bit_ranges
from mipmap_plugin.backends.cpu_kernels.planes import PATCH

# Splats whose patches are found before the first of them is drawn: drawing waits for nothing then, and what is finished is left out.
BATCH = 32

new_found = scratch(BATCH, types.int64)


@inner
def prefetch_rows(array, rows, begin, end):
    """Bring the rows[begin..end] of an array [n, m] into the cache, while others are worked on."""
    for at in range(begin, end):
        prefetch(array, rows[at])


@inner
def find_patches(table, members, patches, begin, end, box, found):
    """Write the patches that each of the members begin..end of a tile's list touches: a bit for each. found: `new_found`."""
    for at in range(begin, end, WIDTH):
        outline = outlines(table, members, at, end)
        first, second = columns_in_row(0, outline, box), columns_in_row(1, outline, box)
        third, fourth = columns_in_row(2, outline, box), columns_in_row(3, outline, box)
        begins, ends = (first[0], second[0], third[0], fourth[0]), (first[1], second[1], third[1], fourth[1])
        store_bit_ranges(found, begins, ends)
        for lane in range(min(WIDTH, end - at)):
            patches[at + lane] = found[lane]


@inner
def columns_in_row(row, outline, box):
    """The first of the patches in a row of a tile that each ellipse touches, and the one after the last."""
    left, top, width, height = box
    if row * PATCH >= height:
        return broadcast(0), broadcast(0)
    x, shear = outline[layout.X] - np.float32(left + 0.5), outline[layout.SHEAR]
    above = np.float32(row * PATCH + top + 0.5) - outline[layout.Y]
    below, rightmost = above + (PATCH - 1), outline[layout.RIGHTMOST_DY]
    dy_of_right, dy_of_left = minimum(maximum(rightmost, above), below), minimum(maximum(0 - rightmost, above), below)
    margin, right = half_width(outline, dy_of_right)
    _, leftwards = half_width(outline, dy_of_left)
    right, left_edge = fma(dy_of_right, shear, x) + right, fma(dy_of_left, shear, x) - leftwards
    end = select(margin >= 0, maximum(floor(minimum(right, width - 1) * (1 / PATCH)) + 1, 0), 0)
    return minimum(maximum(ceil((left_edge - (PATCH - 1)) * (1 / PATCH)), 0), end), end


@inner
def half_width(outline, dy):
    """log2 of alpha over 1/255 on the ellipses' center lines, `dy` px from their centers, and px from there to where alpha falls below 1/255."""
    margin = fma(dy * dy, 0 - outline[layout.FALL_Y], outline[layout.PEAK] - np.float32(LOG_MIN_ALPHA))
    return margin, sqrt(maximum(margin, 0) * outline[layout.PER_FALL_X]) + SLACK


assert TILE_HEIGHT == 4 * PATCH  # a word of 16 bits for each row of patches
