"""The kernels in order: one image, and its gradients."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from torch import Tensor

from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels import compositing, projection, pulling, rounding, sorting, window_tiles
from mipmap_plugin.backends.cpu_kernels.records import SEEN_AT_CENTER, SEEN_IN_PIXEL, SEEN_IN_WINDOW, Frame, Limits, Lists, Splats, View
from mipmap_plugin.backends.cpu_kernels.threads import team
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.splatting.filters import LEAST_COMPENSATION, w_end

SEEN = {"analytic": SEEN_IN_PIXEL, "window": SEEN_IN_WINDOW}

# float32 in a cache line.
LINE = 16


class Drawing(NamedTuple):
    """What the backward pass needs to know of a forward pass."""

    view: View
    splats: Splats
    table: np.ndarray  # [N, COLUMNS]
    slots: np.ndarray  # [N + 1] where each splat's tiles begin
    lists: Lists
    frame: Frame
    limits: Limits


def draw(
    splats: Splats, camera: Camera, effects: Effects, ranks: np.ndarray | None = None, *, gradients: bool = True
) -> tuple[np.ndarray, np.ndarray, Drawing]:
    """The image [H, W, 3], alpha [H, W] and what to remember of them. ranks: [N] int32, front to back, instead of depths.

    gradients: whether `draw_back` will be asked for.
    """
    view = view_of(camera, effects, splats, gradients)
    limits = Limits(effects.settings.max_alpha, effects.settings.min_transmittance, effects.settings.picture_step or 0.0)
    count, (height, width) = len(splats.means), camera.size
    table, depths, counts, slots = _empty(count, col.COLUMNS), _empty(count), np.empty(count, np.int64), np.zeros(count + 1, np.int64)
    shown = _empty(height, width, 3), _empty(height, width)
    frame = Frame(np.array(effects.background, np.float32), _empty(height, width), _empty(height, width))
    threads = team(count + width * height)
    threads.share(projection.project, count, view, splats, table, depths, counts)
    np.cumsum(counts, out=slots[1:])
    lists = sorting.tile_lists(table, depths if ranks is None else ranks, slots, width, height, threads)
    if view.seen == SEEN_IN_WINDOW:
        threads.share(window_tiles.composite, len(lists.starts) - 1, table, lists, frame, shown)
    else:
        threads.share(compositing.composite, len(lists.starts) - 1, view.seen == SEEN_IN_PIXEL, limits, table, lists, frame, shown)
        if limits.picture_step > 0:
            threads.share(rounding.composite, len(lists.starts) - 1, limits, table, lists, frame, shown)
    return *shown, Drawing(view, splats, table, slots, lists, frame, limits)


def draw_back(drawing: Drawing, d_image: np.ndarray, d_alpha: np.ndarray, *, harmonics: bool = True) -> Splats:
    """The gradients of the splats from those of the image [H, W, 3] and its alpha [H, W].

    harmonics: whether those of the coefficients are wanted, which are most of all numbers; else they have no rows.
    """
    view, splats, table, slots, lists, frame, limits = drawing
    pulls, grads = _empty(len(lists.members), col.PULLS), Splats(*(_empty(*array.shape) for array in splats))
    if not harmonics:
        grads = grads._replace(sh=grads.sh[:0])
    threads = team(len(splats.means) + view.width * view.height)
    if view.seen == SEEN_IN_WINDOW:
        threads.share(window_tiles.composite_back, len(lists.starts) - 1, table, lists, frame, (d_image, d_alpha), pulls)
    else:
        integrated = view.seen == SEEN_IN_PIXEL
        threads.share(compositing.composite_back, len(lists.starts) - 1, integrated, limits, table, lists, frame, (d_image, d_alpha), pulls)
    threads.share(pulling.project_back, len(splats.means), view, splats, table, slots, pulls, grads)
    return grads


def view_of(camera: Camera, effects: Effects, splats: Splats, gradients: bool) -> View:
    settings = effects.settings
    left, right = camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
    top, bottom = camera.cy / camera.fy, (camera.height - camera.cy) / camera.fy
    across, down = settings.frozen_beyond * (left + right) / 2, settings.frozen_beyond * (top + bottom) / 2
    rotation, translation = camera.viewmat.numpy()[:3, :3], camera.viewmat.numpy()[:3, 3]
    return View(
        rotation=tuple(map(tuple, rotation.tolist())),
        translation=tuple(translation.tolist()),
        eye=tuple((-np.linalg.solve(rotation, translation)).tolist()),
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
        least_light=LEAST_COMPENSATION.get(effects.screen_filter, 1.0),
        seen=SEEN.get(effects.screen_filter, SEEN_AT_CENTER),
        sh_degree=min(effects.sh_degree, math.isqrt(splats.sh.shape[1]) - 1),
        max_color=math.inf if settings.max_color is None else settings.max_color,
        color_steps=settings.color_steps or (0.0, 0.0, 0.0),
        radial=settings.radial,
        frame=settings.frame,
        min_alpha=settings.min_alpha,
        cut=0.0 if settings.radius is None or settings.fades else math.exp(-(settings.radius**2) / 2),
        faded=w_end(settings),
        culls=settings.culls,
        min_variance=float(settings.min_variance),
        boxed=settings.boxed,
        min_contribution=float(settings.min_contribution),
        least_spread=float(settings.least_spread),
        max_variance=settings.max_variance(camera.width, camera.height),
        felt=gradients,
    )


def splats_of(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor, covariances: Tensor | None) -> Splats:
    """The tensors of `Gaussians` as arrays; of the two ways to give a shape, the one that is not taken is left empty."""
    if covariances is None:
        covariances = means.new_empty(0, 3, 3)
    else:
        quats, scales = quats[:0], scales[:0]
    return Splats(*(tensor.detach().contiguous().numpy() for tensor in (means, quats, scales, opacities, sh, covariances)))


def _empty(*shape: int) -> np.ndarray:
    """float32, not set. Aligned to cache lines, which numpy's memory is not; large ones in huge pages, which torch's is not."""
    count = math.prod(shape)
    room = np.empty(count + LINE, np.float32)
    start = -room.__array_interface__["data"][0] // room.itemsize % LINE
    return room[start : start + count].reshape(shape)
