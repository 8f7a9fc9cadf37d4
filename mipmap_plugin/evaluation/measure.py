"""What all tables share: the clock, the list of baselines without adaptation, and the test whether an evaluated view was adapted to."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.curve import Stopwatch
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.upsamplers import find_upsampler
from mipmap_plugin.adaptation.views.policy import extent
from mipmap_plugin.adaptation.views.shown import showing
from mipmap_plugin.adaptation.warn import silent
from mipmap_plugin.backends import supersample
from mipmap_plugin.camera import Camera
from mipmap_plugin.models.base import count_of, means_at
from mipmap_plugin.wrap import Wrapped

RenderView = Callable[[Camera], Tensor]  # a camera of the base scale -> [h, w, 3]
Kind = Literal["base", "filter", "supersampling", "adapted", "renderer"]

BASE = "base"  # as it is, rendered as in its training
RESIZED = "base, resized"

# Training-free screen filters, for rows beside the base as it is.
FILTERS = ("scaled", "window", "antialiased")

# The window filter treats occlusion correctly as long as a pixel covers at most this many base pixels per axis; beyond that it needs samples.
WINDOW_REACH = 2

# Two views are the same if their centers are closer than this fraction of the cameras' extent (or of their coordinates, whose precision is
# limited) and their rotations closer than this: the distance of poses written with three decimals, less than that of frames of a video.
SAME_PLACE = 1e-3
SAME_DIGITS = 1e-5
SAME_ROTATION = 1e-2  # Frobenius norm, 0.4 degrees
SAME_TIME = 1e-3  # of 0..1


@dataclass(frozen=True)
class Baseline:
    """A way to render a scene at one scale without adaptation."""

    name: str
    kind: Kind
    backend: str  # the backend that renders it
    gaussians: int  # the number of splats that one view shows
    render: RenderView


def supersampled(n: int) -> str:
    """The name of the baseline of n x n samples per pixel."""
    return f"supersampling, {n} x {n}"


def baselines(
    model: Wrapped,
    scale: float,
    shrink_by: str,
    *,
    filters: Sequence[str] = FILTERS,
    samples: Sequence[int] | None = None,
    upsampler: str = "bicubic",
) -> list[Baseline]:
    """The base as it is, each of `filters` that this machine has, supersampling at zoom-out, and the base's own image, resized.

    Samples are clamped before they are averaged, and the base's image before it is resized, like the pseudo truth.
    `shrink_by`: the filter that made the truth, which also shrinks the base's image: the upper limit of zoom-out. `samples`: N for N x N
    samples per pixel, at most as fine as the base's pixels; by default as fine. `upsampler`: adds a row beside the bicubic one at zoom-in.
    At scale 1 there is only the base.
    """

    def rendered(name: str, kind: Kind, screen_filter: str | None, n: int = 1) -> Baseline:
        backend = model.backend(screen_filter=screen_filter)[0].name
        return Baseline(name, kind, backend, shown, lambda view: _render(model, view.zoomed(scale), scale, screen_filter, n))

    def resized(name: str, by: str) -> Baseline:
        render = lambda view: resized_base(model.render(view).image, view.zoomed(scale).size, shrink_by=shrink_by, upsampler=by)  # noqa: E731
        return Baseline(name, "supersampling" if scale < 1 else "filter", model.backend()[0].name, splats_shown(model), render)

    shown = splats_shown(model, scale)  # once, for networks may have to make them
    found = [rendered(BASE, "base", None)]
    if scale == 1:
        return found
    available = [name for name in filters if name != model.trained.screen_filter and not model.lacks(name)]
    found += [rendered(name, "filter", name) for name in available]
    finest = math.ceil(1 / scale)  # samples as fine as the base's own pixels; finer ones make no difference
    counts = (finest,) if samples is None else samples
    found += [rendered(supersampled(n), "supersampling", "scaled", n) for n in counts if 1 < n <= max(2, finest)]
    n = math.ceil(1 / (WINDOW_REACH * scale))
    if "window" in available and n > 1:
        found.append(rendered(f"window, {n} x {n} samples", "supersampling", "window", n))
    found.append(resized(RESIZED, "bicubic"))
    if scale > 1 and upsampler != "bicubic":
        found.append(resized(f"base upsampled by {Path(upsampler).name}", upsampler))
    return found


def base_in_viewer(viewer: str, model: Wrapped, scale: float) -> Baseline:
    """The base as a viewer renders it. Raises SettingsError for an unknown viewer, and BackendUnavailable."""
    backend = model.backend(viewer=viewer)[0].name
    render = lambda view: model.render(view.zoomed(scale), viewer=viewer).image  # noqa: E731
    return Baseline(f"{BASE} in {viewer}", "base", backend, splats_shown(model, scale), render)


def splats_shown(model: Wrapped, scale: float = 1.0) -> int:
    """The number of the base's splats that one view shows at `scale`."""
    return count_of(model.model, model.any_camera(), scale)


def _render(model: Wrapped, camera: Camera, scale: float, screen_filter: str | None, n: int) -> Tensor:
    """The base's view of `camera`, the mean of n x n samples per pixel; filters that depend on the scale keep their size in output pixels."""
    if n == 1:
        return model.render(camera, scale, screen_filter).image
    fine = supersample.of_samples(camera, n).resized(camera.width * n, camera.height * n)
    return resize(model.render(fine, scale * n, screen_filter).image.clamp(0, 1), camera.size, "box")


def resized_base(render: Tensor, size: tuple[int, int], *, shrink_by: str, upsampler: str = "bicubic") -> Tensor:
    """The base's image [H, W, 3], clamped like the pseudo truth and resized to `size`: zoom without any change of splats."""
    render = render.clamp(0, 1)
    if size[0] < render.shape[0]:
        return resize(render, size, "area" if shrink_by == "box" else shrink_by)  # the same, for any ratio
    return find_upsampler(upsampler)(render, size)


@torch.no_grad()
def warm_stopwatch(show: RenderView, view: Camera) -> Stopwatch:
    """A stopwatch for `show`, which first renders `view` once, so that compiling and loading are not counted.

    It synchronizes with a GPU at both ends.
    """
    return Stopwatch(show(view).device)


def warm_up(model: Wrapped, scale: float, cameras: Sequence[Camera]) -> None:
    """Adapt one step on one view, so that compiling at first use is not counted in an adaptation; its warnings are of no use to anyone."""
    near = model.effects().near_plane
    seeing = next(([view] for view in cameras if showing([view], means_at(model.model, view), near)), None)  # one of nothing would be refused
    with silent():
        model.adapt(scale, cameras=seeing, views="given" if seeing else "orbit", extra_views=1, steps=1, validation_views=2)


def adapt_alone(model: Wrapped, scale: float, **options: Any) -> Adapted:
    """Adapt as the first call does: the seconds include every image of the base, whatever earlier calls have drawn. `options`: of `adapt`."""
    model.images = None
    vars(model).pop("viewpoints", None)  # which views are clear
    return model.adapt(scale, **options)


def views_seen(judged: Sequence[Camera], adapted: Sequence[Camera]) -> list[Camera]:
    """The `judged` views that are among the `adapted` ones: of the same pose, whatever the lens, and of the same time if both have one."""
    if not judged or not adapted:
        return []
    views = [*judged, *adapted]
    reach = max(SAME_PLACE * extent(views), SAME_DIGITS * max(float(view.center.norm()) for view in views))
    first, second = _facts(judged), _facts(adapted)
    begin, counts, order = _candidates(first, second, first.new_tensor([reach] * 3 + [SAME_ROTATION] * 9 + [SAME_TIME]))
    left, number = counts.nonzero()[:, 0], 0  # the judged views that are not found yet and have a candidate of that number
    seen = torch.zeros(len(judged), dtype=torch.bool)
    while len(left):
        apart = first[left] - second[order[begin[left] + number]]
        other_time = apart[:, 12].abs() > SAME_TIME  # an unknown time is NaN, which counts as the same
        seen[left] = (apart[:, :3].norm(dim=1) < reach) & (apart[:, 3:12].norm(dim=1) < SAME_ROTATION) & ~other_time
        number += 1
        left = left[~seen[left] & (counts[left] > number)]
    return [view for view, known in zip(judged, seen.tolist(), strict=True) if known]


def _facts(views: Sequence[Camera]) -> Tensor:
    """What tells views apart, [V, 13] float64: center, rotation, and time, NaN if it is unknown."""
    poses = torch.stack([torch.cat([view.center, view.viewmat[:3, :3].flatten()]) for view in views])
    times = poses.new_tensor([math.nan if view.time is None else view.time for view in views])
    return torch.cat([poses, times[:, None]], dim=1)


def _candidates(first: Tensor, second: Tensor, reach: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """For each row of `first` [F, D] the rows of `second` [S, D] within `reach` [D] by one column, that which leaves fewest.

    They are `order[begin : begin + count]`; returns the begins [F], the counts [F], and the order [S].
    """
    found = []
    for ours, theirs, most in zip(first.T, second.T, reach, strict=True):
        if not (ours.isnan().any() or theirs.isnan().any()):
            ordered, order = theirs.sort()
            begin = torch.searchsorted(ordered, ours - most)
            found.append((begin, torch.searchsorted(ordered, ours + most, right=True) - begin, order))
    return min(found, key=lambda column: int(column[1].sum()))
