"""What of each view a tile adapts to: the box on the screen that its core takes, in the views that show enough of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.tiles.splats import Splats

# A view is left out if it shows less than this fraction of the core's blend weight that the view that shows most of it does.
LEAST_SHARE = 0.1

# The box leaves out this fraction of the core's blend weight at each of its sides, and has so many pixels more.
STRAYS, PAD = 0.005, 8

# px: smaller boxes are not adapted to.
LEAST_SIDE = 4

Box = tuple[int, int, int, int]  # left, top, right, bottom


@dataclass(frozen=True, eq=False)
class Crop:
    """A core's box in one view at the new scale."""

    camera: Camera  # of the box; it has the view's name
    box: Box  # px of the view
    share: float  # of the core's blend weight that lies in the view, 0..1; what hides it is not counted


def crops(splats: Splats, core: Tensor, weights: Tensor, views: Sequence[Camera], near: float) -> list[Crop]:
    """The boxes of a core, of rows `core` [M] with blend weights [M], in those of the `views` of the new scale that show enough of it."""
    found = [crop for view in views if (crop := _crop(splats.places[core], weights, view, near)) is not None]
    most = max((crop.share for crop in found), default=0.0)
    return [crop for crop in found if crop.share >= LEAST_SHARE * most]


def _crop(places: Tensor, weights: Tensor, view: Camera, near: float) -> Crop | None:
    x, y, z = view.to_camera(places[:, :3]).unbind(1)
    u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
    inside = (z > near) & (u > 0) & (u < view.width) & (v > 0) & (v < view.height)
    seen = weights * inside
    if not inside.any() or float(seen.sum()) <= 0:
        return None
    reach = (places[:, 3] * view.fx / z)[inside]
    sides = [_side(at[inside] - reach, at[inside] + reach, seen[inside], size) for at, size in ((u, view.width), (v, view.height))]
    (left, right), (top, bottom) = sides
    if min(right - left, bottom - top) < LEAST_SIDE:
        return None
    camera = replace(view, width=right - left, height=bottom - top, cx=view.cx - left, cy=view.cy - top)
    return Crop(camera, (left, top, right, bottom), float(seen.sum() / weights.sum()))


def _side(low: Tensor, high: Tensor, weights: Tensor, size: int) -> tuple[int, int]:
    """The pixels between which splats from `low` to `high` [M] lie, but for strays, within an image of `size` pixels."""
    first, last = _quantile(low, weights, STRAYS), _quantile(high, weights, 1 - STRAYS)
    return max(0, int(first) - PAD), min(size, int(last) + 1 + PAD)


def _quantile(values: Tensor, weights: Tensor, fraction: float) -> float:
    order = values.argsort()
    summed = weights[order].double().cumsum(0)
    place = int(torch.searchsorted(summed, fraction * summed[-1]))
    return float(values[order[min(place, len(values) - 1)]])
