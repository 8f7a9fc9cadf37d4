"""The blend weight of each splat: how much it contributes to the images of a scene."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

import torch
from torch import Tensor

from mipmap_plugin.adaptation.parallel import max_threads, together
from mipmap_plugin.adaptation.start.closed_form import filter_variance
from mipmap_plugin.adaptation.views.pixel_size import pictured
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects, colorless
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.process.threads import side_by_side
from mipmap_plugin.splatting.harmonics import C0

# Pixels: the blend weight from which on a view shows a splat.
SHOWN = 0.1

# Fraction of its `whole_weights` below which nothing is known of a splat: no view shows it, or only through gaps. These are 2 to 24 % of a scene,
# and 61 % of a capture of which one side is shown.
UNSEEN = 1e-3

# The most parts that views are divided in, of which part k has every PARTS-th view from the k-th on.
PARTS = 4


class Wanted(NamedTuple):
    """What splats show in the base's images."""

    weights: Tensor  # [N, P] pixels: what each of P parts of the views adds to the mean blend weight over all
    whole: Tensor  # [N] pixels: the weights of splats that nothing hides (`whole_weights`)
    areas: Tensor  # [N] px² of the base or the target, whichever has the larger pixels (`areas`)


def blend_weights(gaussians: Gaussians, views: Sequence[Camera], backend: Backend, effects: Effects) -> Tensor:
    """The blend weight of each splat, summed over the pixels of a view and averaged over `views`: [N] in pixels; 0 for an invisible splat."""
    total = torch.zeros_like(gaussians.opacities)
    for some in _of_views(gaussians, views, backend, effects):
        total += some.sum(0)
    return total / len(views)


def weighed(
    gaussians: Gaussians, views: Sequence[Camera], parts: Sequence[int], backend: Backend, effects: Effects, size: float = 1.0
) -> tuple[Tensor, float]:
    """What each part of the views adds to `blend_weights`, [N, P], and the fraction of the splats that a view shows.

    That is the mean over `views`; what is hidden behind others does not count. `parts`: the number of each view's part, below `PARTS`.
    `size`: a fraction of the views' own, at which they are drawn; the dilation keeps its size in the world.
    """
    total, shown = gaussians.opacities.new_zeros(PARTS, len(gaussians)), torch.zeros_like(gaussians.opacities)
    views = views if size == 1 else [view.zoomed(size) for view in views]
    effects = replace(effects, eps2d=effects.eps2d * size**2, settings=effects.settings.finer(size))
    for part, weights in zip(parts, chain.from_iterable(_of_views(gaussians, views, backend, effects)), strict=True):
        total[part] += weights
        shown += weights > SHOWN * size**2
    return total.T / (len(views) * size**2), float(shown.mean()) / len(views)


def _of_views(gaussians: Gaussians, views: Sequence[Camera], backend: Backend, effects: Effects) -> Iterator[Tensor]:
    """The sum of each splat's blend weights over each view, [V, N] for each batch of views.

    An image is linear in the splats' colors, so that the weights are the gradient of the image's sum with respect to the colors. Works
    with any backend that has gradients, and faster with one that computes them itself, for a view (`Backend.blend_weights`) or for several
    (`Backend.weigh_views`).
    """
    plain = colorless(effects)
    weigh = getattr(backend, "blend_weights", None)
    gray = replace(gaussians, sh=torch.zeros_like(gaussians.sh[:, :1]))

    def weights(view: Camera) -> Tensor:
        known: Tensor | None = None if weigh is None else weigh(gray, view, plain)
        return (_color_gradient(gray, view, backend, plain) if known is None else known)[None]

    if (weigh_views := getattr(backend, "weigh_views", None)) is None:
        return side_by_side(weights, views, max_threads(gaussians.means, views[0]))
    size = together(gaussians.means, views)
    return (weigh_views(gray, [(view, plain) for view in views[start : start + size]]) for start in range(0, len(views), size))


def whole_weights(gaussians: Gaussians, pixel: Tensor, views: Sequence[Camera], base: Effects, scale: float) -> Tensor:
    """[N]: the blend weight of each splat, in target pixels of a view of the base, if it lay in all pictures and nothing hid it.

    `pixel`, `base`: as of `areas`. The area is at most that of a picture.
    """
    picture = sum(view.width * view.height for view in views) / len(views)
    return gaussians.opacities * (2 * math.pi * areas(gaussians, pixel, base)).clamp_max(picture) * scale**2


def areas(gaussians: Gaussians, pixel: Tensor, base: Effects) -> Tensor:
    """[N], base px²: the product of each splat's two standard deviations in a picture, the root mean square over all directions.

    `pixel` [N]: the size of a base pixel there, in world units; `base`: how the base is rendered.
    """
    a, b, c = ((gaussians.scales / pixel[:, None]).square() + filter_variance(base)).unbind(1)
    return ((a * b + b * c + c * a) / 3).sqrt()


def wanted_of(weights: Tensor, gaussians: Gaussians, pixel: Tensor, views: Sequence[Camera], base: Effects, scale: float) -> Wanted:
    """What splats with these blend weights [N, P] show in the base's images; the others: as of `whole_weights`."""
    return Wanted(weights, whole_weights(gaussians, pixel, views, base, scale), areas(gaussians, pixel, base) * min(1.0, scale) ** 2)


def may_show(weights: Tensor, whole: Tensor, means: Tensor, views: Sequence[Camera], looked_at: Sequence[Camera]) -> Tensor:
    """[N] bool: which splats the views show, by their `weights` in the views `looked_at`, or may show: those only in pictures of other views.

    `whole` [N]: `whole_weights`; `means` [N, 3].
    """
    seen = weights > UNSEEN * whole
    if len(looked_at) < len(views):
        rest = (~seen).nonzero()[:, 0]
        seen[rest] = pictured(means[rest], views) & ~pictured(means[rest], looked_at)
    return seen


@torch.enable_grad()
def _color_gradient(gray: Gaussians, view: Camera, backend: Backend, effects: Effects) -> Tensor:
    """The sum of each splat's blend weights over a view, [N], by the gradient of the colors of `gray` splats."""
    color = gray.sh.clone().requires_grad_()
    backend.render(replace(gray, sh=color), view, effects).image.sum().backward()
    assert color.grad is not None
    return color.grad[:, 0].mean(dim=1) / C0
