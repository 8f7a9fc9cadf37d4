"""Views of the same splats, and their gradients: the kernels in order, each for all views at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from torch import Tensor

from mipmap_plugin.backends.cpu_kernels import compositing, compositing_back, layout, projection, projection_back, rounding, sorting, window_tiles
from mipmap_plugin.backends.cpu_kernels.columns import BANDS
from mipmap_plugin.backends.cpu_kernels.records import AT_CENTER, OVER_PIXEL, OVER_WINDOW, Flags, Frame, Limits, Lists, SplatArrays, View
from mipmap_plugin.backends.cpu_kernels.threads import Team, team
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.process.pool import empty
from mipmap_plugin.splatting.filters import LEAST_COMPENSATION, w_end
from mipmap_plugin.splatting.projection import slope_limits

SAMPLING = {"analytic": OVER_PIXEL, "window": OVER_WINDOW}

# Splats whose gradients are summed over the views at a time: their gradients, 236 bytes each, stay in the cache from view to view. A quarter as many
# take 3 % longer on small scenes, for they need more calls, and as long on large ones.
ROWS = 1 << 13


class Shot(NamedTuple):
    """A view to be drawn."""

    camera: Camera
    effects: Effects
    ranks: np.ndarray | None = None  # [N] int32, front to back; sorts splats instead of their depths


class Drawing(NamedTuple):
    """A view: what is drawn, and what the backward pass needs of it."""

    view: View
    flags: Flags
    limits: Limits
    table: np.ndarray  # [N, SPLAT_FIELDS]
    lists: Lists
    frame: Frame
    image: np.ndarray  # [H, W, 3]
    alpha: np.ndarray  # [H, W]


class Projection(NamedTuple):
    """A view whose splats are projected."""

    shot: Shot
    view: View
    flags: Flags
    splats: sorting.Projected


def draw(splats: SplatArrays, shots: Sequence[Shot], *, gradients: bool = True) -> list[Drawing]:
    """Draw several views of the same splats. gradients: whether `draw_back` will be called."""
    return draw_projected(project(splats, shots, gradients=gradients))


def project(splats: SplatArrays, shots: Sequence[Shot], *, gradients: bool = True) -> list[Projection]:
    """The first part of `draw`: what each view shows of each splat."""
    count = len(splats.means)
    views = [view_of(shot.camera, shot.effects, splats, gradients) for shot in shots]
    projected = [sorting.Projected.of(count, shot.camera.size) for shot in shots]
    jobs = [(count, (flags, view, splats, *of.arrays)) for (view, flags), of in zip(views, projected, strict=True)]
    team_for(projected).share_all(projection.project, jobs, of_rows=True)
    projected = [of if shot.ranks is None else of._replace(order=shot.ranks) for shot, of in zip(shots, projected, strict=True)]
    return [Projection(shot, view, flags, of) for shot, (view, flags), of in zip(shots, views, projected, strict=True)]


def draw_projected(projections: Sequence[Projection]) -> list[Drawing]:
    """The rest of `draw`."""
    projected = [each.splats for each in projections]
    threads = team_for(projected)
    drawings = [_blank(each, lists) for each, lists in zip(projections, sorting.tile_lists(projected, threads), strict=True)]
    _composite(drawings, threads)
    return drawings


def team_for(projected: Sequence[sorting.Projected]) -> Team:
    """The threads that pay for these views."""
    return team(sum(len(of.table) + of.size[0] * of.size[1] for of in projected))


def _blank(projected: Projection, lists: Lists) -> Drawing:
    """A view whose picture is not drawn yet."""
    shot, view, flags, of = projected
    (height, width), settings = of.size, shot.effects.settings
    frame = Frame(np.array(shot.effects.background, np.float32), empty(height, width), empty(height, width))
    limits = Limits(*settings.divisible, settings.picture_step or 0.0)
    return Drawing(view, flags, limits, of.table, lists, frame, empty(height, width, 3), empty(height, width))


def _composite(drawings: Sequence[Drawing], threads: Team) -> None:
    """Draw the pictures."""
    windows, points, rounded = [], [], []
    for d in drawings:
        tiles, arguments = len(d.lists.starts) - 1, (d.table, d.lists, d.frame, (d.image, d.alpha))
        if d.view.sampling == OVER_WINDOW:
            windows.append((tiles, arguments))
        else:
            points.append((tiles, (d.flags.integrated, d.limits, *arguments)))
        if d.limits.picture_step > 0 and d.view.sampling != OVER_WINDOW:
            rounded.append((tiles, (d.limits, *arguments)))
    threads.share_all(window_tiles.composite, windows)
    threads.share_all(compositing.composite, points)
    threads.share_all(rounding.composite, rounded)


def draw_back(
    splats: SplatArrays, drawings: Sequence[Drawing], d_outputs: Sequence[tuple[np.ndarray, np.ndarray]], *, harmonics: bool = True
) -> SplatArrays:
    """The gradients of the splats, summed over the views, from those of each view's image [H, W, 3] and alpha [H, W].

    harmonics: whether to compute those of the coefficients, by far the largest array; else that array is empty.
    """
    threads = team(sum(len(splats.means) + drawn.alpha.size for drawn in drawings))
    views = list(zip(drawings, tile_gradients(drawings, d_outputs), strict=True))
    grads = SplatArrays(*(empty(*array.shape) for array in splats))
    if not harmonics:
        grads = grads._replace(sh=grads.sh[:0])

    def add(start: int, stop: int) -> None:
        for first in range(start, stop, ROWS):
            last = min(first + ROWS, stop)
            own = SplatArrays(*(array[first:last] for array in grads))
            for array in own:
                array[:] = 0
            add_views(first, last, splats, views, own)

    threads.share(add, len(splats.means), of_rows=True)
    return grads


def tile_gradients(drawings: Sequence[Drawing], d_outputs: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    """The gradient table [pairs, GRADS] of each view, from the gradients of its image [H, W, 3] and alpha [H, W]."""
    threads = team(sum(len(drawn.table) + drawn.alpha.size for drawn in drawings))
    tables = [empty(len(drawn.lists.members), layout.GRADS) for drawn in drawings]
    windows, points = [], []
    for d, outputs, into in zip(drawings, d_outputs, tables, strict=True):
        tiles = len(d.lists.starts) - 1
        if d.view.sampling == OVER_WINDOW:
            windows.append((tiles, (d.table, d.lists, d.frame, outputs, into)))
        else:
            points.append((tiles, (d.flags.integrated, d.flags.reshaped, d.flags.faded, d.limits, d.table, d.lists, d.frame, outputs, into)))
    threads.share_all(window_tiles.composite_back, windows)
    threads.share_all(compositing_back.composite_back, points)
    return tables


def add_views(start: int, stop: int, splats: SplatArrays, views: Sequence[tuple[Drawing, np.ndarray]], grads: SplatArrays) -> None:
    """Add the gradients of the splats start..stop, from the views' gradient tables, to the rows of `grads`.

    What no view shows has none, and costs nothing.
    """
    for drawn, table in views:
        projection_back.project_back(start, stop, drawn.flags, drawn.view, splats, drawn.table, drawn.lists.firsts, table, grads)


def view_of(camera: Camera, effects: Effects, splats: SplatArrays, gradients: bool) -> tuple[View, Flags]:
    """The camera, effects and settings as kernels need them, and what these are compiled with."""
    return _view_of(camera, effects, splats.sh.shape[1], len(splats.covariances) > 0, gradients)


@lru_cache(maxsize=1024)
def _view_of(camera: Camera, effects: Effects, bands: int, covariances: bool, gradients: bool) -> tuple[View, Flags]:
    """`view_of` for such splats: an adaptation draws the same views again and again, and this takes as long as 1000 splats."""
    view = _made(camera, effects, math.isqrt(bands) - 1, gradients)
    on = dict(
        covariances=covariances,
        integrated=view.sampling != AT_CENTER,
        reshaped=view.culls or view.max_variance < math.inf,
        faded=view.w_end > 0,
        fourth=view.sh_degree > 3,
        third=view.sh_degree == 3 and bands == BANDS,
    )
    return view, Flags(**{name: True if is_on else None for name, is_on in on.items()})


def _made(camera: Camera, effects: Effects, sh_degree: int, gradients: bool) -> View:
    settings = effects.settings
    left, right, top, bottom = slope_limits(camera, settings)
    rotation, translation = camera.viewmat.numpy()[:3, :3], camera.viewmat.numpy()[:3, 3]
    return View(
        rotation=tuple(map(tuple, rotation.tolist())),
        translation=tuple(translation.tolist()),
        eye=tuple((-np.linalg.solve(rotation, translation)).tolist()),
        fx=float(camera.fx),
        fy=float(camera.fy),
        cx=float(camera.cx),
        cy=float(camera.cy),
        left=left,
        right=right,
        top=top,
        bottom=bottom,
        width=camera.width,
        height=camera.height,
        near_plane=float(effects.near_plane),
        eps2d=float(effects.eps2d),
        min_compensation=LEAST_COMPENSATION.get(effects.screen_filter, 1.0),
        sampling=SAMPLING.get(effects.screen_filter, AT_CENTER),
        sh_degree=min(effects.sh_degree, sh_degree),
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
        rooted=settings.rooted,
        least_spread=float(settings.least_spread),
        level_below=float(settings.level_below),
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
