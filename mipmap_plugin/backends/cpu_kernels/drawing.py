"""One image and its gradients: the kernels in order."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from torch import Tensor

from mipmap_plugin.backends.cpu_kernels import compositing, compositing_back, layout, projection, projection_back, rounding, sorting, window_tiles
from mipmap_plugin.backends.cpu_kernels.records import AT_CENTER, OVER_PIXEL, OVER_WINDOW, Flags, Frame, Limits, Lists, SplatArrays, View
from mipmap_plugin.backends.cpu_kernels.threads import team
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.pool import empty
from mipmap_plugin.splatting.filters import LEAST_COMPENSATION, w_end

SAMPLING = {"analytic": OVER_PIXEL, "window": OVER_WINDOW}


class Drawing(NamedTuple):
    """What the backward pass needs of a forward pass."""

    view: View
    splats: SplatArrays
    table: np.ndarray  # [N, SPLAT_FIELDS]
    slots: np.ndarray  # [N + 1] each splat's first slot
    lists: Lists
    frame: Frame
    limits: Limits


def draw(
    splats: SplatArrays, camera: Camera, effects: Effects, ranks: np.ndarray | None = None, *, gradients: bool = True
) -> tuple[np.ndarray, np.ndarray, Drawing]:
    """The image [H, W, 3], alpha [H, W] and what `draw_back` needs. ranks: [N] int32, front to back; sorts splats instead of their depths.

    gradients: whether `draw_back` will be called.
    """
    view = view_of(camera, effects, splats, gradients)
    limits = Limits(effects.settings.max_alpha, effects.settings.min_transmittance, effects.settings.picture_step or 0.0)
    count, (height, width) = len(splats.means), camera.size
    table, depths, counts, slots = empty(count, layout.SPLAT_FIELDS), empty(count), np.empty(count, np.int64), np.zeros(count + 1, np.int64)
    outputs = empty(height, width, 3), empty(height, width)
    frame = Frame(np.array(effects.background, np.float32), empty(height, width), empty(height, width))
    threads = team(count + width * height)
    flags = flags_of(view, splats)
    threads.share(projection.project, count, flags, view, splats, table, depths, counts)
    np.cumsum(counts, out=slots[1:])
    lists = sorting.tile_lists(table, depths if ranks is None else ranks, slots, width, height, threads)
    if view.sampling == OVER_WINDOW:
        threads.share(window_tiles.composite, len(lists.starts) - 1, table, lists, frame, outputs)
    else:
        threads.share(compositing.composite, len(lists.starts) - 1, flags.integrated, limits, table, lists, frame, outputs)
        if limits.picture_step > 0:
            threads.share(rounding.composite, len(lists.starts) - 1, limits, table, lists, frame, outputs)
    return *outputs, Drawing(view, splats, table, slots, lists, frame, limits)


def draw_back(drawing: Drawing, d_image: np.ndarray, d_alpha: np.ndarray, *, harmonics: bool = True) -> SplatArrays:
    """The gradients of the splats from those of the image [H, W, 3] and its alpha [H, W].

    harmonics: whether to compute those of the coefficients, by far the largest array; else that array is empty.
    """
    view, splats, table, slots, lists, frame, limits = drawing
    tile_grads, grads = empty(len(lists.members), layout.GRADS), SplatArrays(*(empty(*array.shape) for array in splats))
    if not harmonics:
        grads = grads._replace(sh=grads.sh[:0])
    threads, flags = team(len(splats.means) + view.width * view.height), flags_of(view, splats)
    if view.sampling == OVER_WINDOW:
        threads.share(window_tiles.composite_back, len(lists.starts) - 1, table, lists, frame, (d_image, d_alpha), tile_grads)
    else:
        arguments = flags.integrated, flags.reshaped, flags.faded, limits, table, lists, frame, (d_image, d_alpha), tile_grads
        threads.share(compositing_back.composite_back, len(lists.starts) - 1, *arguments)
    threads.share(projection_back.project_back, len(splats.means), flags, view, splats, table, slots, tile_grads, grads)
    return grads


def flags_of(view: View, splats: SplatArrays) -> Flags:
    """What kernels are compiled with."""
    on = dict(
        covariances=len(splats.covariances) > 0,
        integrated=view.sampling != AT_CENTER,
        reshaped=view.culls or view.max_variance < math.inf,
        faded=view.w_end > 0,
        fourth=view.sh_degree > 3,
    )
    return Flags(**{name: True if is_on else None for name, is_on in on.items()})


def view_of(camera: Camera, effects: Effects, splats: SplatArrays, gradients: bool) -> View:
    """The camera, effects and settings as kernels need them."""
    settings = effects.settings
    left, right = camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
    top, bottom = camera.cy / camera.fy, (camera.height - camera.cy) / camera.fy
    margin_x, margin_y = settings.frozen_beyond * (left + right) / 2, settings.frozen_beyond * (top + bottom) / 2
    rotation, translation = camera.viewmat.numpy()[:3, :3], camera.viewmat.numpy()[:3, 3]
    return View(
        rotation=tuple(map(tuple, rotation.tolist())),
        translation=tuple(translation.tolist()),
        eye=tuple((-np.linalg.solve(rotation, translation)).tolist()),
        fx=float(camera.fx),
        fy=float(camera.fy),
        cx=float(camera.cx),
        cy=float(camera.cy),
        left=-left - margin_x,
        right=right + margin_x,
        top=-top - margin_y,
        bottom=bottom + margin_y,
        width=camera.width,
        height=camera.height,
        near_plane=float(effects.near_plane),
        eps2d=float(effects.eps2d),
        min_compensation=LEAST_COMPENSATION.get(effects.screen_filter, 1.0),
        sampling=SAMPLING.get(effects.screen_filter, AT_CENTER),
        sh_degree=min(effects.sh_degree, math.isqrt(splats.sh.shape[1]) - 1),
        max_color=math.inf if settings.max_color is None else settings.max_color,
        color_steps=settings.color_steps or (0.0, 0.0, 0.0),
        radial=settings.radial,
        max_offset=settings.frame,
        min_alpha=settings.min_alpha,
        w_cut=0.0 if settings.radius is None or settings.fades else math.exp(-(settings.radius**2) / 2),
        w_end=w_end(settings),
        culls=settings.culls,
        min_variance=float(settings.min_variance),
        boxed=settings.boxed,
        min_contribution=float(settings.min_contribution),
        least_spread=float(settings.least_spread),
        max_variance=settings.max_variance(camera.width, camera.height),
        lists_culled=gradients,
    )


def as_arrays(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor, covariances: Tensor | None) -> SplatArrays:
    """The tensors of `Gaussians` as arrays. Covariances, if there are any, replace quats and scales; what is not in use is empty."""
    if covariances is None:
        covariances = means.new_empty(0, 3, 3)
    else:
        quats, scales = quats[:0], scales[:0]
    return SplatArrays(*(tensor.detach().contiguous().numpy() for tensor in (means, quats, scales, opacities, sh, covariances)))
