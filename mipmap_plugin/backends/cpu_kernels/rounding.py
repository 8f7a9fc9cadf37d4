"""Pictures of few bits: the image again, back to front, rounded after each splat. The gradient remains that of the unrounded image."""

# numba redefines calls and operators.
# mypy: ignore-errors

from mipmap_plugin.backends.cpu_kernels import inner, kernel, layout
from mipmap_plugin.backends.cpu_kernels.compositing import alpha_of, fill_range, tile_box
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, fma, lowest_bit, maximum, minimum, select
from mipmap_plugin.backends.cpu_kernels.memory import load, pointer, row_of, store
from mipmap_plugin.backends.cpu_kernels.patches import BATCH, find_patches, new_found
from mipmap_plugin.backends.cpu_kernels.planes import PATCH, PLANE, distances, new_state, offset_of
from mipmap_plugin.backends.cpu_kernels.powers import ROUNDER


@kernel
def composite(start, stop, limits, table, lists, frame, outputs):
    """Draw the image [H, W, 3] of the tiles start..stop again; `lists` are sorted."""
    starts, members, patches = lists.starts, pointer(lists.members), pointer(lists.patches)
    background, transmittance, _ = frame
    image, _ = outputs
    height, width = transmittance.shape
    state, found = new_state(), new_found()
    for tile in range(start, stop):
        box = tile_box(tile, width, height)
        left, top, tile_width, tile_height = box
        for k in range(3):
            fill_range(state, k * PLANE, (k + 1) * PLANE, background[k])
        for end in range(starts[tile + 1], starts[tile], -BATCH):
            begin = max(end - BATCH, starts[tile])
            find_patches(table, members, patches, begin, end, box, found)
            for at in range(end - 1, begin - 1, -1):
                splat = row_of(table, members[at])
                if splat[layout.GATE] > 0:
                    draw_splat(splat, limits, patches[at], box, state)
        for r in range(tile_height):
            for c in range(tile_width):
                for k in range(3):
                    image[top + r, left + c, k] = state[k * PLANE + offset_of(r, c - c % PATCH) + c % PATCH]


@inner
def draw_splat(splat, limits, patches, box, state):
    """Blend a splat over those already blended."""
    max_alpha, _, step = limits
    while patches != 0:
        patch = lowest_bit(patches)
        patches &= patches - 1
        (alpha, bright), at = alpha_of(splat, None, *distances(splat, patch, box)), patch * WIDTH
        alpha = select(bright, minimum(alpha, max_alpha), 0)
        blend_channel(alpha, splat[layout.RED], step, at, state)
        blend_channel(alpha, splat[layout.GREEN], step, PLANE + at, state)
        blend_channel(alpha, splat[layout.BLUE], step, 2 * PLANE + at, state)


@inner
def blend_channel(alpha, color, step, at, state):
    """Blend one channel of 16 pixels, rounded to multiples of `step` and clamped to 0..1."""
    before = load(state, at)
    added = minimum(alpha * color, 1)
    after = (fma(1 - alpha, before, added) * (1 / step) + ROUNDER - ROUNDER) * step
    store(state, at, select(alpha > 0, minimum(maximum(after, 0), 1), before))
