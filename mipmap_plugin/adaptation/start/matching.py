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
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from mipmap_plugin.adaptation.start.base_weights import BaseWeights
from mipmap_plugin.adaptation.start.blend_weights import Wanted, blend_weights
from mipmap_plugin.adaptation.start.clock import Clock
from mipmap_plugin.adaptation.start.closed_form import filter_suffices
from mipmap_plugin.adaptation.start.problem import StartProblem
from mipmap_plugin.adaptation.views.pixel_size import LEAST_VIEWS
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import SURFEL
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.screen_filters import INTEGRATED

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

# What is said where a time budget ended before opacities were matched, which gains some dB.
UNMATCHED = "the time budget left no time to fit opacities to what splats show in the base's images, so that the start has less dB than it could"


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


class Matcher:
    """Matches the opacities of a start's candidates, in as many sweeps as there is time for."""

    def __init__(self, problem: StartProblem, clock: Clock, seen: BaseWeights) -> None:
        """`seen`: says in which views, and at which size, weights are measured; its notes tell where there was no time."""
        self._problem, self._clock, self._seen = problem, clock, seen
        self.sweeps: tuple[int, ...] | None = None  # that are made; None: the usual ones
        spreads = problem.target.screen_filter == SURFEL or problem.target.screen_filter in INTEGRATED  # otherwise than by a variance in px²
        suffices = filter_suffices(problem.base_effects, problem.target)
        self.is_of_use = problem.has_blend_weights and not suffices and (problem.scale <= 1 or not spreads)

    @property
    def possible(self) -> Sweeps:
        """The sweeps over the views that splats are weighed in."""
        return sweeps_over(self._views())

    def sweeps_for(self, weights: Tensor | None) -> tuple[int, ...]:
        """The sweeps that are made: none without blend weights, and no more than there is time for."""
        if not self.is_of_use or weights is None:
            return ()
        sweeps = asked = self.possible.usual if self.sweeps is None else self.sweeps
        while sweeps and not self.allows(weights, sweeps):
            sweeps = sweeps[:-1]
        if asked and not sweeps and UNMATCHED not in self._seen.notes:
            self._seen.notes.append(UNMATCHED)
        return sweeps

    def allows(self, weights: Tensor, sweeps: Sequence[int]) -> bool:
        """Whether there is time for such sweeps over splats of these weights [N, P]: in less of it than the base's if these and pixels are fewer."""
        share = max(len(weights) / len(self._seen.of_base.whole), (self._size / self._seen.size) ** 2)
        return self._clock.allows("weights", share * len(sweeps) * len(self._seen.views) / LEAST_VIEWS)

    def matched(self, splats: Gaussians, wanted: Wanted, sweeps: Sequence[int]) -> Tensor:
        """The opacities [N] of splats in closed form, for what is wanted of them."""
        problem, views = self._problem, self._views()
        finer = problem.scale / self._size
        target = replace(problem.target, eps2d=problem.target.eps2d / finer**2, settings=problem.target.settings.finer(1 / finer))

        def weights_of(opacities: Tensor, part: int, parts: int) -> Tensor:
            some = views[part::parts]
            return blend_weights(replace(splats, opacities=opacities), some, problem.backend, target) * (finer**2 * len(some) / len(views))

        return matched_opacities(splats.opacities, wanted, weights_of, sweeps)

    @property
    def _size(self) -> float:
        """The fraction of their size at which views are weighed: a zoom-in in images of the base's size, for sums over pixels need no finer ones."""
        return min(self._seen.size, self._problem.scale)

    def _views(self) -> list[Camera]:
        return [view.zoomed(self._size) for view in self._seen.views]
