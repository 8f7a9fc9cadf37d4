"""Front-to-back compositing of tiles: splat by splat, over the patches of 4 x 4 pixels that its ellipse touches.

`planes` updates the pixels themselves.
"""

# numba redefines calls and operators.
# mypy: ignore-errors

from mipmap_plugin.backends.cpu_kernels import inner, integrals, kernel, layout
from mipmap_plugin.backends.cpu_kernels.binning import LOG_MIN_ALPHA, TILE_HEIGHT, TILE_WIDTH, tile_grid
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, bits, fma, lowest_bit
from mipmap_plugin.backends.cpu_kernels.memory import load, pointer, row_of
from mipmap_plugin.backends.cpu_kernels.patches import BATCH, find_patches, new_found, prefetch_rows
from mipmap_plugin.backends.cpu_kernels.planes import (
    BEHIND_DOT_GRAD,
    PATCH,
    PATCHES,
    PLANE,
    STOPS,
    TRANSMITTANCE,
    blend,
    distances,
    new_state,
    offset_of,
)
from mipmap_plugin.backends.cpu_kernels.powers import exp2
from mipmap_plugin.backends.cpu_kernels.sorting import sort
from mipmap_plugin.render_settings import MIN_ALPHA


@inner
def tile_box(tile, width, height):
    """Left, top, width and height of a tile, px."""
    tiles_x, _ = tile_grid(width, height)
    left, top = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
    return left, top, min(TILE_WIDTH, width - left), min(TILE_HEIGHT, height - top)


@kernel
def composite(start, stop, integrated, limits, table, lists, frame, outputs):
    """Render the tiles start..stop into `frame`, and into the outputs: image [H, W, 3] and alpha [H, W].

    integrated: True where splats are integrated over pixels, else None.
    """
    sort(start, stop, lists)
    starts, members, patches = lists.starts, pointer(lists.members), pointer(lists.patches)
    _, transmittance, _ = frame
    height, width = transmittance.shape
    state, found = new_state(), new_found()
    for tile in range(start, stop):
        box, first = tile_box(tile, width, height), starts[tile]
        length = starts[tile + 1] - first
        init_tile(box, length, state)
        for begin in range(0, length, BATCH):
            unfinished = unfinished_patches(state)
            if unfinished == 0:
                break
            end = min(begin + BATCH, length)
            prefetch_rows(table, members, first + end, first + min(end + BATCH, length))
            find_patches(table, members, patches, first + begin, first + end, box, found)
            for n in range(begin, end):
                splat = row_of(table, members[first + n])
                if integrated is not None or splat[layout.GATE] > 0:
                    draw_splat(splat, integrated, limits, patches[first + n] & unfinished, n, box, state)
        write_tile(box, state, frame, outputs)


@inner
def fill_range(state, first, last, value):
    for at in range(first, last):
        state[at] = value


@inner
def init_tile(box, length, state):
    """Clear the state. A negative transmittance marks a pixel that stopped, as all outside the image have from the start."""
    _, _, tile_width, tile_height = box
    fill_range(state, 0, TRANSMITTANCE, 0)
    fill_range(state, TRANSMITTANCE, STOPS, -1)
    fill_range(state, STOPS, BEHIND_DOT_GRAD, length)
    for r in range(tile_height):
        for c in range(0, tile_width, PATCH):
            at = TRANSMITTANCE + offset_of(r, c)
            fill_range(state, at, at + min(PATCH, tile_width - c), 1)


@inner
def unfinished_patches(state):
    """A bit per patch of which some pixel has not stopped."""
    patches = 0
    for patch in range(PATCHES):
        if bits(load(state, TRANSMITTANCE + patch * WIDTH) >= 0) != 0:
            patches |= 1 << patch
    return patches


@inner
def draw_splat(splat, integrated, limits, patches, n, box, state):
    """Blend a splat, the n-th of its tile, behind those already blended, into `patches`."""
    color = splat[layout.RED], splat[layout.GREEN], splat[layout.BLUE]
    while patches != 0:
        patch = lowest_bit(patches)
        patches &= patches - 1
        alpha, bright = alpha_of(splat, integrated, *distances(splat, patch, box))
        blend(alpha, bright, limits, color, n, patch * WIDTH, state)


@inner
def alpha_of(splat, integrated, dx, dy):
    """A splat's alpha at lanes of pixels dx, dy px from its center, and where that reaches 1/255 or where the splat ends.

    One that is integrated may reach less in its outline, which is that of its bounding ellipse.
    """
    if integrated is not None:
        alpha = integrals.alpha(splat, dx, dy)
        return alpha, alpha >= MIN_ALPHA
    u = fma(dy, 0 - splat[layout.SHEAR], dx)
    power = fma(u * u, 0 - splat[layout.FALL_X], fma(dy * dy, 0 - splat[layout.FALL_Y], splat[layout.PEAK]))
    return fma(exp2(power), splat[layout.GAIN], 0 - splat[layout.OFFSET]), power >= LOG_MIN_ALPHA


@inner
def write_tile(box, state, frame, outputs):
    """Write a tile's pixels to the frame and the outputs."""
    left, top, tile_width, tile_height = box
    background, transmittance, stops = frame
    image, alpha = outputs
    width = transmittance.shape[1]
    colors, alphas, transmittances, stop_list = pointer(image), pointer(alpha), pointer(transmittance), pointer(stops)
    for r in range(tile_height):
        for c in range(tile_width):
            at, pixel = offset_of(r, c - c % PATCH) + c % PATCH, (top + r) * width + left + c
            remaining = abs(state[TRANSMITTANCE + at])
            for k in range(3):
                colors[3 * pixel + k] = state[k * PLANE + at] + remaining * background[k]
            transmittances[pixel], alphas[pixel] = remaining, 1 - remaining
            stop_list[pixel] = state[STOPS + at]
