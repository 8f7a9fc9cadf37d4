"""Blend weights: how much each splat adds to an image. One pass, where the gradients of the colors need two and nine times the memory."""

# numba redefines calls and operators.
# mypy: ignore-errors

import numpy as np

from mipmap_plugin.backends.cpu_kernels import inner, kernel, layout, sorting
from mipmap_plugin.backends.cpu_kernels.compositing import alpha_of, init_tile, tile_box, unfinished_patches
from mipmap_plugin.backends.cpu_kernels.drawing import Shot, project, team_for
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, broadcast, lowest_bit, minimum, select
from mipmap_plugin.backends.cpu_kernels.memory import load, pointer, row_of, store
from mipmap_plugin.backends.cpu_kernels.patches import BATCH, find_patches, new_found
from mipmap_plugin.backends.cpu_kernels.planes import TRANSMITTANCE, distances, new_state
from mipmap_plugin.backends.cpu_kernels.records import Limits, SplatArrays
from mipmap_plugin.backends.cpu_kernels.sums import total
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.process.pool import empty


def weigh(splats: SplatArrays, camera: Camera, effects: Effects, ranks: np.ndarray | None = None) -> np.ndarray:
    """The sum of each splat's blend weights over the pixels of an image, [N] float32. Arguments: as of `drawing.draw`; not for windows."""
    [projection] = project(splats, [Shot(camera, effects, ranks)], gradients=False)
    count, projected, limits = len(splats.means), projection.splats, Limits(*effects.settings.divisible, 0.0)
    threads = team_for([projected])
    [lists] = sorting.tile_lists([projected], threads)
    by_pair, by_splat = empty(len(lists.members)), empty(count)
    threads.share(weigh_tiles, len(lists.starts) - 1, projection.flags.integrated, limits, projected.table, lists, projected.size, by_pair)
    threads.share(sum_pairs, count, lists.firsts, by_pair, by_splat, of_rows=True)
    return by_splat


@kernel
def weigh_tiles(start, stop, integrated, limits, table, lists, size, by_pair):
    """Write the weight of each pair of the tiles start..stop to its slot. integrated: as of `compositing.composite`."""
    sorting.sort(start, stop, lists)
    starts, members, slots, patches = lists.starts, pointer(lists.members), lists.slots, pointer(lists.patches)
    height, width = size
    state, found = new_state(), new_found()
    for tile in range(start, stop):
        box, first = tile_box(tile, width, height), starts[tile]
        length = starts[tile + 1] - first
        for at in range(first, first + length):
            by_pair[slots[at]] = 0
        init_tile(box, length, state)
        for begin in range(0, length, BATCH):
            unfinished = unfinished_patches(state)
            if unfinished == 0:
                break
            end = min(begin + BATCH, length)
            find_patches(table, members, patches, first + begin, first + end, box, found)
            for n in range(begin, end):
                splat = row_of(table, members[first + n])
                if integrated is not None or splat[layout.GATE] > 0:
                    by_pair[slots[first + n]] = weigh_splat(splat, integrated, limits, patches[first + n] & unfinished, box, state)


@kernel
def sum_pairs(start, stop, firsts, by_pair, by_splat):
    """Add up the pairs of the splats start..stop."""
    for i in range(start, stop):
        weight = np.float32(0)
        for slot in range(firsts[i], firsts[i + 1]):
            weight += by_pair[slot]
        by_splat[i] = weight


@inner
def weigh_splat(splat, integrated, limits, patches, box, state):
    """Blend a splat into `patches`; returns the sum of its weights (as `compositing.draw_splat`)."""
    weights = broadcast(0)
    while patches != 0:
        patch = lowest_bit(patches)
        patches &= patches - 1
        alpha, bright = alpha_of(splat, integrated, *distances(splat, patch, box))
        weights = weights + blended(alpha, bright, limits, patch * WIDTH, state)
    return total(weights)


@inner
def blended(alpha, bright, limits, at, state):
    """The weights in the patch at `at`, whose transmittances are updated as in `planes.blend`."""
    max_alpha, min_transmittance, _ = limits
    alpha, before = select(bright, minimum(alpha, max_alpha), 0), load(state, TRANSMITTANCE + at)
    after = before * (1 - alpha)
    is_open = after >= min_transmittance
    store(state, TRANSMITTANCE + at, select(is_open, after, minimum(before, 0 - before)))
    return select(is_open, before * alpha, 0)
