"""The kernels in order: one image, and its gradients. Work is cut into ranges that threads take as they come free."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.backends.cpu_kernels import binning, compositing, projection
from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels.records import Frame, Lists, Splats, View
from mipmap_plugin.backends.filters import LEAST_LIGHT
from mipmap_plugin.backends.projection import FRUSTUM_MARGIN
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects

# Work is cut finer than there are threads: crowded tiles take longer than others. Much finer, and handing it out would take time.
RANGES_PER_THREAD = 16


class Drawing(NamedTuple):
    """What the backward pass needs to know of a forward pass."""

    view: View
    table: np.ndarray  # [N, COLUMNS]
    slots: np.ndarray  # [N + 1] where each splat's tiles begin
    lists: Lists
    frame: Frame


def draw(splats: Splats, camera: Camera, effects: Effects) -> tuple[np.ndarray, Drawing]:
    """The image [H, W, 3] and what to remember of it."""
    view = view_of(camera, effects, splats)
    count, (height, width) = len(splats.means), camera.size
    table, depths, counts = _empty(count, col.COLUMNS), _empty(count), np.empty(count, np.int64)
    _share(projection.project, count, view, splats, table, depths, counts)

    slots = np.concatenate([[0], np.cumsum(counts)])
    tiles = np.empty(slots[-1], np.int32)
    _share(binning.cover, count, table, slots, width, height, tiles)
    columns, rows = binning.tile_grid(width, height)
    lists = Lists(*binning.fill_lists(binning.depth_order(depths, counts), slots, tiles, columns * rows))

    image, frame = _empty(height, width, 3), Frame(np.array(effects.background, np.float32), _empty(height, width), _empty(height, width))
    _share(compositing.composite, columns * rows, view.integrated, table, lists, frame, image)
    return image, Drawing(view, table, slots, lists, frame)


def draw_back(drawing: Drawing, splats: Splats, d_image: np.ndarray, d_alpha: np.ndarray) -> Splats:
    """The gradients of the splats from those of the image [H, W, 3] and its alpha [H, W]."""
    view, table, slots, lists, frame = drawing
    pulls = _empty(len(lists.members), col.PULLS)
    _share(compositing.composite_back, len(lists.starts) - 1, view.integrated, table, lists, frame, (d_image, d_alpha), pulls)
    grads = Splats(*(_empty(*array.shape) for array in splats))
    _share(projection.project_back, len(splats.means), view, splats, table, slots, pulls, grads)
    return grads


def view_of(camera: Camera, effects: Effects, splats: Splats) -> View:
    left, right = camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
    top, bottom = camera.cy / camera.fy, (camera.height - camera.cy) / camera.fy
    across, down = FRUSTUM_MARGIN * (left + right) / 2, FRUSTUM_MARGIN * (top + bottom) / 2
    return View(
        rotation=tuple(tuple(row) for row in camera.viewmat[:3, :3].tolist()),
        translation=tuple(camera.viewmat[:3, 3].tolist()),
        eye=tuple(camera.center.tolist()),
        fx=float(camera.fx),
        fy=float(camera.fy),
        cx=float(camera.cx),
        cy=float(camera.cy),
        left=-left - across,
        right=right + across,
        top=-top - down,
        bottom=bottom + down,
        width=camera.width,
        height=camera.height,
        near=float(effects.near_plane),
        eps2d=float(effects.eps2d),
        least_light=LEAST_LIGHT.get(effects.screen_filter, 1.0),
        integrated=effects.screen_filter == "analytic",
        sh_degree=min(effects.sh_degree, math.isqrt(splats.sh.shape[1]) - 1),
    )


def splats_of(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor, covariances: Tensor | None) -> Splats:
    """The tensors of `Gaussians` as arrays; of the two ways to give a shape, the one that is not taken is left empty."""
    if covariances is None:
        covariances = means.new_empty(0, 3, 3)
    else:
        quats, scales = quats[:0], scales[:0]
    return Splats(*(tensor.detach().contiguous().numpy() for tensor in (means, quats, scales, opacities, sh, covariances)))


def _empty(*shape: int) -> np.ndarray:
    return torch.empty(shape).numpy()  # aligned to cache lines, which numpy's own memory is not


def _share(kernel: Callable[..., None], count: int, *arguments) -> None:
    """Run `kernel(start, stop, *arguments)` over 0..count on torch's number of threads.

    Threads live as long as the call: an idle pool would not survive a fork, and two callers would get in each other's way.
    """
    threads = min(torch.get_num_threads(), count)
    if threads < 2:
        kernel(0, count, *arguments)
        return
    step = -(-count // (threads * RANGES_PER_THREAD))
    starts = iter(range(0, count, step))

    def work() -> None:
        for start in starts:
            kernel(start, min(start + step, count), *arguments)

    with ThreadPoolExecutor(threads - 1) as pool:
        others = [pool.submit(work) for _ in range(threads - 1)]
        work()
        for other in others:
            other.result()
