"""What every table measures by: one clock, one list of rivals that need no adapting, and whether a judged view was adapted to."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from mipmap_plugin.adaptation.curve import Stopwatch
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.upsamplers import find_upsampler
from mipmap_plugin.adaptation.views import extent
from mipmap_plugin.camera import Camera
from mipmap_plugin.wrap import Wrapped

Show = Callable[[Camera], Tensor]  # a camera of the base scale -> [h, w, 3]
Kind = Literal["base", "filter", "supersampling", "adapted", "renderer"]

BASE = "base"  # as it is, as a renderer of its training draws it
RESIZED = "base, resized"

# Screen filters that need no training, for the rows beside the base as it is.
FILTERS = ("scaled", "window", "antialiased")

# A window sees through splats in front of it rightly as long as a pixel is at most so many of the base's: with more it needs samples.
WINDOW_REACH = 2

# Two views are one where their eyes are nearer than this share of the cameras' extent (or of their coordinates, whose digits end there) and
# their rotations nearer than this: about as far apart as poses are that were written with three decimals, and nearer than frames of a video.
SAME_PLACE = 1e-3
SAME_DIGITS = 1e-5
SAME_ROTATION = 1e-2  # Frobenius norm, 0.4 degrees
SAME_TIME = 1e-3  # of 0..1


@dataclass(frozen=True)
class Rival:
    """A way to show a scene at one scale that needs no adapting."""

    name: str
    kind: Kind
    backend: str  # that draws it
    show: Show


def rivals(
    model: Wrapped,
    scale: float,
    shrink_by: str,
    *,
    filters: Sequence[str] = FILTERS,
    samples: Sequence[int] | None = None,
    upsampler: str = "bicubic",
) -> list[Rival]:
    """The base as it is, each of `filters` that this machine has, supersampling at zoom-out, and the base's own image, resized.

    Samples are clamped before they are averaged, and the base's image before it is resized, as the pseudo truth is.
    `shrink_by`: the filter that made the truth, which makes the base's image smaller too: the ceiling of zoom-out. `samples`: N for N x N
    samples a pixel, finer than the base's pixels left out; by default as fine. `upsampler`: has a row beside the bicubic one at zoom-in.
    At scale 1 there is the base alone.
    """

    def drawn(name: str, kind: Kind, screen_filter: str | None, n: int = 1) -> Rival:
        backend = model.backend(screen_filter=screen_filter)[0].name
        return Rival(name, kind, backend, lambda view: _drawn(model, view.zoomed(scale), scale, screen_filter, n))

    def resized(name: str, by: str) -> Rival:
        show = lambda view: resized_base(model.render(view).image, view.zoomed(scale).size, shrink_by=shrink_by, upsampler=by)  # noqa: E731
        return Rival(name, "supersampling" if scale < 1 else "filter", model.backend()[0].name, show)

    found = [drawn(BASE, "base", None)]
    if scale == 1:
        return found
    served = [name for name in filters if name != model.trained.screen_filter and not model.lacks(name)]
    found += [drawn(name, "filter", name) for name in served]
    finest = math.ceil(1 / scale)  # samples as fine as the base's own pixels; finer ones show nothing more
    wanted = (finest,) if samples is None else samples
    found += [drawn(f"supersampling, {n} x {n}", "supersampling", "scaled", n) for n in wanted if 1 < n <= max(2, finest)]
    n = math.ceil(1 / (WINDOW_REACH * scale))
    if "window" in served and n > 1:
        found.append(drawn(f"window, {n} x {n} samples", "supersampling", "window", n))
    found.append(resized(RESIZED, "bicubic"))
    if scale > 1 and upsampler != "bicubic":
        found.append(resized(f"base upsampled by {Path(upsampler).name}", upsampler))
    return found


def base_in(viewer: str, model: Wrapped, scale: float) -> Rival:
    """The base as a viewer draws it. Raises SettingsError for an unknown one, and BackendUnavailable."""
    backend = model.backend(viewer=viewer)[0].name
    return Rival(f"{BASE} in {viewer}", "base", backend, lambda view: model.render(view.zoomed(scale), viewer=viewer).image)


def _drawn(model: Wrapped, camera: Camera, scale: float, screen_filter: str | None, n: int) -> Tensor:
    """The base's view of `camera`, the mean of n x n samples a pixel; filters that know of the zoom keep their size in pixels of the output."""
    if n == 1:
        return model.render(camera, scale, screen_filter).image
    fine = camera.resized(camera.width * n, camera.height * n)
    return resize(model.render(fine, scale * n, screen_filter).image.clamp(0, 1), camera.size, "box")


def resized_base(render: Tensor, size: tuple[int, int], *, shrink_by: str, upsampler: str = "bicubic") -> Tensor:
    """The base's image [H, W, 3] at `size`, clamped first as the pseudo truth is: what zoom costs when no splat is touched."""
    render = render.clamp(0, 1)
    if size[0] < render.shape[0]:
        return resize(render, size, "area" if shrink_by == "box" else shrink_by)  # the same, for any ratio
    return find_upsampler(upsampler)(render, size)


@torch.no_grad()
def warm_watch(show: Show, view: Camera) -> Stopwatch:
    """A stopped watch for `show`, which has drawn `view` once already: what compiles or loads at first is not billed.

    It waits for the work of a GPU at both ends.
    """
    return Stopwatch(show(view).device)


def warm_up(model: Wrapped, scale: float, cameras: Sequence[Camera]) -> None:
    """One step on one view, so that what compiles at first use is not billed to an adaptation."""
    model.adapt(scale, cameras=cameras[:1], views="given" if cameras else "orbit", extra_views=1, steps=1, validation_views=2)


def seen_before(judged: Sequence[Camera], adapted: Sequence[Camera]) -> list[Camera]:
    """Those of the `judged` views that are among the `adapted` ones: the same pose, whatever the lens, and the same time where both have one."""
    if not judged or not adapted:
        return []
    every = [*judged, *adapted]
    reach = max(SAME_PLACE * extent(every), SAME_DIGITS * max(float(view.center.norm()) for view in every))
    near = _distances(judged, adapted, lambda view: view.center) < reach
    alike = _distances(judged, adapted, lambda view: view.viewmat[:3, :3].flatten()) < SAME_ROTATION
    later = _distances(judged, adapted, lambda view: view.center.new_tensor([math.nan if view.time is None else view.time])) > SAME_TIME
    same = near & alike & ~later  # an unknown time, NaN, is no later one
    return [view for view, seen in zip(judged, same.any(dim=1).tolist(), strict=True) if seen]


def _distances(some: Sequence[Camera], others: Sequence[Camera], of: Callable[[Camera], Tensor]) -> Tensor:
    """[S, O] between what two lists of views have."""
    rows, columns = (torch.stack([of(view) for view in views]) for views in (some, others))
    return torch.cdist(rows, columns, compute_mode="donot_use_mm_for_euclid_dist")  # exact for near ones
