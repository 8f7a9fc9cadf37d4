"""The size of a pixel at each splat, in world units, over the views that show it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from mipmap_plugin.adaptation.parallel import in_batches, in_chunks
from mipmap_plugin.backends.cpu import finest_pixels
from mipmap_plugin.camera import Camera, every_nth
from mipmap_plugin.models.base import SplatModel, means_at

# Number of views from which the area and the blend weight of a splat are computed. It starts at LEAST_VIEWS and is doubled, up to MOST_VIEWS, until
# a splat is in SEEN of them on average. Twelve suffice for an object, but would show only a third of the splats of a walk through nine rooms.
LEAST_VIEWS, MOST_VIEWS, SEEN = 12, 192, 8.0

# The closest view of a splat is looked for among this many times as many views: looking is cheap, and to miss it costs captures 1 to 2.5 dB.
CLOSEST_OF = 4

# If fewer than RARE of these views have a splat in their pictures, the closest view is easily missed. It is then looked for in further views, up to
# all of them, with at most MOST_LOOKS tests for all such splats together, which take a second.
RARE, MOST_LOOKS = 1 / 3, 1 << 23

# The quantile of the sizes of pixels at a scene's splats that stands for its nearest parts. The smallest would be that of floaters before a camera.
NEAREST = 0.05

# A scene is unbounded if its pixels are more than this many times as large at its far parts as at its near ones: 1.3 times for lego, 16 for flowers.
UNBOUNDED = 3.0

# Splats that are counted in views, to tell how many views are enough.
COUNTED = 1 << 14


def enough_views(means: Tensor, views: Sequence[Camera]) -> int:
    """How many views, evenly spread over `views`, show enough of the splats at `means` [N, 3]."""
    some, points = every_nth(views, LEAST_VIEWS), means[:: max(1, len(means) // COUNTED)]
    shares = [view.in_picture(view.to_camera(points)).float().mean(1) for view in in_batches(some, points)]
    return views_for(float(torch.cat(shares).mean()))


def views_for(share: float) -> int:
    """How many views are enough if each shows this fraction of the splats."""
    count = LEAST_VIEWS
    while share * count < SEEN and count < MOST_VIEWS:
        count *= 2
    return count


def pixel_size(means: Tensor, views: Sequence[Camera], count: int | None = None, most: float = 0.0) -> Tensor:
    """The size of a pixel at each mean in the closest view that sees it: [N] in world units.

    What no view sees has the size in the closest of all views, but at most `most` or the largest of what is seen: nobody says that it is looked at
    from here, and another room, a kilometer away, would become a blur. If nothing at all is seen, there is no such limit.
    Of many views only some are used, evenly spread: CLOSEST_OF times `count`, by default `enough_views`; and more for splats that few of these see.
    """
    some = every_nth(views, _closest_of(means, views, count))
    finest, seeing = _finest(means, some)
    rare = (seeing < RARE * len(some)).nonzero()[:, 0]
    further = every_nth(views, max(len(some), MOST_LOOKS // max(1, len(rare))))
    if len(rare) and len(further) > len(some):
        finest[rare] = torch.minimum(finest[rare], _finest(means[rare], further)[0])
    unseen = finest.isinf()
    if not unseen.any():
        return finest
    largest = torch.cat([finest[~unseen], finest.new_tensor([most])]).max().item() or math.inf
    return finest.masked_scatter(unseen, _nearest(means[unseen], some).clamp_max(largest))


def target_pixel(model: SplatModel, views: Sequence[Camera], scale: float) -> float:
    """The size of a pixel of the new scale at the median splat of a model, in world units; `views`: of the base scale."""
    return float(pixel_size(means_at(model, views[0]), views).median()) / scale


def mean_pixel_size(means: Tensor, views: Sequence[Camera], count: int | None = None) -> Tensor:
    """The size ρ of a pixel at each mean for which a variance of c·ρ² is closest to c px² in the views v that see it: [N] in world units.

    By least squares over c·ρ²/ρᵥ²: ρ² = Σρᵥ⁻² / Σρᵥ⁻⁴, so that close views count most. What no view sees has `pixel_size`. The views are those
    of `pixel_size`.
    """
    some = every_nth(views, _closest_of(means, views, count))

    def of_chunk(chunk: slice) -> Tensor:
        squares, fourths = torch.zeros(2, len(means[chunk]), dtype=torch.float64, device=means.device)  # whose range powers do not leave
        for view in in_batches(some, means[chunk]):
            points = view.to_camera(means[chunk])
            rates = torch.where(view.in_picture(points), view.mean_focal / points[..., 2], 0.0).double().square()
            squares, fourths = squares + rates.sum(0), fourths + rates.square().sum(0)
        mean: Tensor = (squares / fourths).sqrt().to(means)
        return mean

    found = torch.cat(in_chunks(of_chunk, means))
    unseen = ~found.isfinite()
    if not unseen.any():
        return found
    largest = torch.cat([found[~unseen], found.new_zeros(1)]).max().item()
    return found.masked_scatter(unseen, pixel_size(means[unseen], views, count, largest))


def pictured(means: Tensor, views: Sequence[Camera]) -> Tensor:
    """[N] bool: which means [N, 3] lie in the picture of a view."""
    return _finest(means, views)[1] > 0


def seen_pixel_size(means: Tensor, views: Sequence[Camera], near: float) -> Tensor:
    """`pixel_size` of those of the means [N, 3] that are in a picture, beyond `near` (world units): [M], M at most N; 0 if nothing is seen."""
    seen, _ = _finest(means, every_nth(views, _closest_of(means, views)), near)
    if not seen.isfinite().any():  # few of many views may show something
        seen, _ = _finest(means, views, near)
    return seen[seen.isfinite()]


def nearest(pixels: Tensor) -> float:
    """The size of a pixel at the nearest parts of a scene, from the sizes [N] at its splats that are seen, at least one (`NEAREST`)."""
    return float(_quantile(pixels, NEAREST))


def is_unbounded(means: Tensor, views: Sequence[Camera], near: float) -> bool:
    """Whether the near and the far parts of a scene need scales of their own; not if nothing is seen.

    `means` [N, 3]; `views`: of its training; `near`: its near plane, in world units.
    """
    pixels = seen_pixel_size(means, views, near)
    return len(pixels) > 0 and bool(_quantile(pixels, 1 - NEAREST) > UNBOUNDED * _quantile(pixels, NEAREST))


def seen_depth(view: Camera, means: Tensor, near: float, part: float) -> float:
    """The depth, world units, before which this part of the splats at `means` [N, 3] in a view's picture lies; infinity if none is in it.

    What is not farther than `near` is not in it.
    """
    points = view.to_camera(means)
    depths = points[view.in_picture(points, near), 2]
    return float(depths.kthvalue(1 + int(part * (len(depths) - 1))).values) if len(depths) else math.inf


def _closest_of(means: Tensor, views: Sequence[Camera], count: int | None = None) -> int:
    """The number of views among which the closest one is looked for."""
    return min(MOST_VIEWS, CLOSEST_OF * (count or enough_views(means, views)))


def _finest(means: Tensor, views: Sequence[Camera], near: float = 0.0) -> tuple[Tensor, Tensor]:
    """The size of a pixel at each mean in the closest view that sees it, [N], infinity if none does; and the number of views that see it, [N]."""
    if (known := finest_pixels(means, views, near)) is not None:
        return known

    def of_chunk(chunk: slice) -> tuple[Tensor, Tensor]:
        finest, seeing = torch.full_like(means[chunk, 0], torch.inf), torch.zeros_like(means[chunk, 0])
        rows = means[chunk].T.contiguous().T  # whose coordinates lie one after the other, as they are read
        for view in in_batches(views, rows):
            points = view.to_camera(rows)
            seen = view.in_picture(points, near)
            sizes = torch.where(seen, points[..., 2] / view.mean_focal, torch.inf)
            finest, seeing = torch.minimum(finest, sizes.amin(0)), seeing + seen.sum(0)
        return finest, seeing

    finest, seeing = zip(*in_chunks(of_chunk, means), strict=True)
    return torch.cat(finest), torch.cat(seeing)


def _nearest(means: Tensor, views: Sequence[Camera]) -> Tensor:
    """The size of a pixel at each mean in the closest of all views, [N], by the distance, since a depth may be 0 or negative."""
    least = torch.finfo(means.dtype).eps
    batches = in_batches(views, means)
    nearest = [((means - view.center).norm(dim=-1).clamp_min(least) / view.mean_focal).amin(0) for view in batches]
    return torch.stack(nearest).amin(0)


def _quantile(values: Tensor, share: float) -> Tensor:
    """As torch.quantile, which refuses more than 16 million values."""
    return values.kthvalue(min(len(values), 1 + round(share * (len(values) - 1)))).values
