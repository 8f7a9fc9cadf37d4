"""Opacities that give each splat the blend weight that it had in the base's images.

A dilated splat covers a larger area, and the closed form lowers its opacity by the same factor; at zoom-in it raises it. But the coverage
of overlapping splats is not the sum of their areas, and splats behind them shine through more. Both are corrected by measuring the blend
weight of each splat in the target's images, and multiplying its opacity by the ratio of the wanted to the measured weight: iterative
proportional fitting (Deming and Stephan 1940), damped where it overshoots. Opacities change after each part of the views, as in tomography
(ordered subsets, Hudson and Larkin 1994, "Accelerated image reconstruction using ordered subsets of projection data"): once over the views in
four parts comes as close as three times over all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera

# The most parts that views are divided in, of which part k has every PARTS-th view from the k-th on.
PARTS = 4

# A part has at least so many views, and so many pixels of the size at which they are weighed. With half as many views lego has 0.4 to 0.7 dB less at
# x1/4; with 864 pixels, for 39,000 splats, 0.8 dB at x1/16.
PART_VIEWS, PART_PIXELS = 6, 10_000

# An opacity changes by at most this factor per part.
MAX_FACTOR = 4.0

# Pixels: an invisible blend weight, added to keep ratios finite.
INVISIBLE_WEIGHT = 1e-4

# Fraction of the weight that a splat would have if nothing hid it, added too: what shows of hidden splats, or at the edge of a view, says little
# of their opacities. A capture of which one side is shown keeps 1 dB more of the others by it.
HARDLY_SEEN = 1e-3

# px² of the base or the target, whichever has the larger pixels: a splat of a larger area looks alike with both filters. If its weight changes, that
# is the doing of smaller splats before it, and to make up for it by its own opacity would show what it hides to views from elsewhere. So opacities
# change the less the larger splats are beyond this (docs/recipes_found.md).
WIDE = 16.0


class Wanted(NamedTuple):
    """What splats show in the base's images."""

    weights: Tensor  # [N, P] pixels: what each of P parts of the views adds to the mean blend weight over all
    whole: Tensor  # [N] pixels: the weights of splats that nothing hides (`blend_weights.whole_weights`)
    areas: Tensor  # [N] px² of the base or the target, whichever has the larger pixels (`blend_weights.areas`)


class Sweeps(NamedTuple):
    """How often all views are looked at, and in how many parts (1, 2 or 4) each time."""

    usual: tuple[int, ...]
    further: tuple[int, ...]  # where no step follows: captures gain up to 1.2 dB by them, lego 1.1


# By the number of parts that the views can be divided in.
SWEEPS = {4: Sweeps((4,), (2, 1, 1)), 2: Sweeps((2, 2), (1, 1)), 1: Sweeps((1, 1, 1), (1, 1, 1))}


def sweeps_over(views: Sequence[Camera]) -> Sweeps:
    """The sweeps over `views`, of the size at which splats are weighed in them."""
    pixels = sum(view.width * view.height for view in views)
    return next(sweeps for parts, sweeps in SWEEPS.items() if parts <= max(1, min(len(views) // PART_VIEWS, pixels // PART_PIXELS)))


@torch.no_grad()
def matched_opacities(
    opacities: Tensor, wanted: Wanted, weights_of: Callable[[Tensor, int, int], Tensor], sweeps: Sequence[int]
) -> Tensor:
    """Opacities [N] with which splats have the `wanted` blend weights, as far as they are not `WIDE`.

    `weights_of(opacities, part, parts)` [N]: the weights with these opacities, of every `parts`-th view from number `part` on. `sweeps`: divisors of
    the number of parts.
    """
    known, before = INVISIBLE_WEIGHT + HARDLY_SEEN * wanted.whole, None
    mean, narrow = wanted.weights.sum(1) + known, WIDE / wanted.areas.clamp_min(WIDE)
    for parts in sweeps:
        for part in range(parts):
            here = wanted.weights[:, part::parts].sum(1) + known / parts
            ratio = here / (weights_of(opacities, part, parts) + known / parts)
            overshot = torch.zeros_like(ratio, dtype=torch.bool) if before is None else (ratio > 1) != (before > 1)
            factor = torch.where(overshot, ratio.sqrt(), ratio)  # half of the way, as factors go: too far before, or other views say so
            factor = factor ** (narrow * (parts * here / mean).clamp_max(1))  # less of it where other parts show more of a splat
            opacities, before = (opacities * factor.to(opacities).clamp(1 / MAX_FACTOR, MAX_FACTOR)).clamp_max(1), ratio
    return opacities
