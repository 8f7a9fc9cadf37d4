"""The start of a level: from the finer one, splats that are smaller than its pixels are merged and shaped, and all others stay."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.adaptation.start.closed_form import AREA_POWER, MIN_AXIS, min_variance
from mipmap_plugin.adaptation.start.merging import merge
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.levels.request import KEPT, POWER
from mipmap_plugin.screen_filters import COMPENSATED


def kept_splats(pixels: Tensor, size: float, ratio: float) -> int:
    """How many of the base's splats that are merged for pixels of `size` are kept: as many as a ladder by zoom keeps at the scale of each.

    `pixels` [N]: the size of a pixel at each of the base's splats in its training, in world units.
    """
    scales = pixels[pixels < size] / size
    return math.ceil(float((KEPT * (ratio**POWER - 1) * scales.double() ** POWER).clamp_max(1).sum()))


def coarsened(
    splats: Gaussians, pixel_of: Callable[[Tensor], Tensor], sizes: tuple[float, float], weights: Tensor | None, kept: int, target: Effects
) -> tuple[Gaussians, int]:
    """The splats of a level before optimization, and how many of them, which come first, are those of the finer level as they were.

    `pixel_of`: the size of a pixel at means [N, 3] in their closest training view, [N] in world units. `sizes`: of a pixel of the finer level (0: of
    training) and of this one. `weights`: the blend weight of each splat [N], in pixels of the training views; None: nothing is merged. `kept`: how
    many are left of those that are merged.
    """
    finer, coarser = sizes
    pixels = pixel_of(splats.means)
    changes = pixels < coarser
    still, moved = splats[~changes], splats[changes]
    if weights is not None and kept < len(moved):
        in_pixels = weights[changes] * (pixels[changes] / coarser).square()
        moved, _ = merge(moved, torch.full_like(in_pixels, coarser), in_pixels[:, None], kept / len(moved))
    scales, opacities = shaped(moved, pixel_of(moved.means).clamp(finer, coarser), coarser, target)
    return still.joined(replace(moved, scales=scales, opacities=opacities)), len(still)


def shaped(splats: Gaussians, before: Tensor, after: float, target: Effects) -> tuple[Tensor, Tensor]:
    """Scales [N, 3] and opacities [N] that look in pixels of size `after` as they do in pixels of size `before` [N], both in world units.

    This is the closed form (`start.closed_form`) in the world instead of in views: the dilation grows with the pixel, so that a splat becomes
    thinner, and where it cannot, less opaque, by its root mean square area over all directions. A filter that compensates needs no change.
    """
    if target.screen_filter in COMPENSATED:
        return splats.scales, splats.opacities
    dilation = target.eps2d * before.square()[:, None], target.eps2d * after**2
    wide = splats.scales.square() + dilation[0]
    thinnest = torch.full_like(wide, MIN_AXIS**2).scatter(1, wide.topk(2, dim=1).indices, max(MIN_AXIS**2, min_variance(target)))
    narrow = (wide - dilation[1]).clamp_min(0).maximum(thinnest * after**2)
    ratio = (_area(wide) / _area(narrow + dilation[1])).clamp_max(1)
    return narrow.sqrt(), splats.opacities * ratio**AREA_POWER


def _area(variances: Tensor) -> Tensor:
    """[N], up to a factor: the root mean square over all directions of the area of ellipsoids with these variances [N, 3] along their axes."""
    a, b, c = variances.unbind(-1)
    return (a * b + b * c + c * a).sqrt()
