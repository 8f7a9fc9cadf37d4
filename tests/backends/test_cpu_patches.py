"""The patches of a tile that splats touch, against the pixels that they light."""

import numpy as np
import pytest
import torch

numba = pytest.importorskip("numba")
from mipmap_plugin.backends.cpu_kernels import drawing, layout  # noqa: E402
from mipmap_plugin.backends.cpu_kernels.binning import LOG_MIN_ALPHA, TILE_HEIGHT, TILE_WIDTH  # noqa: E402
from mipmap_plugin.backends.cpu_kernels.planes import PATCH, PATCH_COLUMNS  # noqa: E402
from mipmap_plugin.camera import Camera  # noqa: E402
from mipmap_plugin.effects import Effects  # noqa: E402

WIDTH, HEIGHT = 101, 39  # px: no multiples of tiles or patches


@pytest.fixture(scope="module")
def drawn():
    """Faint splats of all sizes, most of them needles, so that no pixel stops early."""
    torch.manual_seed(0)
    count = 500
    scales = torch.rand(count, 3).pow(3) * 0.3 + 0.001
    means = torch.randn(count, 3) * torch.tensor([0.8, 0.4, 0.2])
    quats, opacities = torch.nn.functional.normalize(torch.randn(count, 4), dim=1), torch.full((count,), 0.02)
    splats = drawing.as_arrays(means, quats, scales, opacities, torch.zeros(count, 1, 3), None)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[2, 3] = 2
    [drawing_of] = drawing.draw(splats, [drawing.Shot(Camera(WIDTH, HEIGHT, 80.0, 80.0, WIDTH / 2, HEIGHT / 2, viewmat), Effects(0))])
    return drawing_of


def lit_patches(row, left, top):
    """The patches in which a splat's alpha reaches 1/255 at the center of a pixel, as bits."""
    y, x = np.mgrid[top : min(top + TILE_HEIGHT, HEIGHT), left : min(left + TILE_WIDTH, WIDTH)] + 0.5
    dy = y - row[layout.Y]
    u = x - row[layout.X] - row[layout.SHEAR] * dy
    lit = row[layout.PEAK] - row[layout.FALL_Y] * dy**2 - row[layout.FALL_X] * u**2 >= LOG_MIN_ALPHA
    return {(int(r) // PATCH) * PATCH_COLUMNS + int(c) // PATCH for r, c in zip(*lit.nonzero(), strict=True)}


def test_every_lit_pixel_is_in_a_patch_that_is_visited(drawn):
    lists, columns, visited, needed = drawn.lists, -(-WIDTH // TILE_WIDTH), 0, 0
    for tile, (first, last) in enumerate(zip(lists.starts[:-1], lists.starts[1:], strict=True)):
        left, top = tile % columns * TILE_WIDTH, tile // columns * TILE_HEIGHT
        for member, patches in zip(lists.members[first:last], lists.patches[first:last].tolist(), strict=True):
            found, lit = {bit for bit in range(64) if patches >> bit & 1}, lit_patches(drawn.table[member].astype(np.float64), left, top)
            assert lit <= found
            visited, needed = visited + len(found), needed + len(lit)
    assert needed > 1000 and visited < 1.3 * needed  # ellipses reach patches in which they touch no pixel's center


def test_every_splat_is_in_the_list_of_each_tile_that_it_lights(drawn):
    lists, columns = drawn.lists, -(-WIDTH // TILE_WIDTH)
    for tile, (first, last) in enumerate(zip(lists.starts[:-1], lists.starts[1:], strict=True)):
        left, top, listed = tile % columns * TILE_WIDTH, tile // columns * TILE_HEIGHT, set(lists.members[first:last].tolist())
        shown = np.diff(lists.firsts) > 0
        assert all(i in listed for i in shown.nonzero()[0].tolist() if lit_patches(drawn.table[i].astype(np.float64), left, top))
        slots = lists.slots[first:last]
        assert np.array_equal(lists.splats[slots], lists.members[first:last])
