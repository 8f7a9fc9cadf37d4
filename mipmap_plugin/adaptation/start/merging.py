"""Fewer, larger splats for a coarser image: pairs of neighbors of similar color are merged, the pairs of least cost first.

At x1/8 thousands of splats share a pixel, and a classic renderer dilates every one of them. A pair is replaced by one splat with the same
total weight, mean and covariance (moment matching, as in Runnalls 2007, "Kullback-Leibler approach to Gaussian mixture reduction"), where
the weights are the splats' blend weights. The cost of a pair is that of Ward's method (1963, "Hierarchical grouping to optimize an
objective function"); many pairs are merged at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count as count_from

import torch
from torch import Tensor

from mipmap_plugin.adaptation.parallel import CHUNK, in_chunks
from mipmap_plugin.backends.cpu import nearest_along
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.morton import morton_codes
from mipmap_plugin.process import threads
from mipmap_plugin.splatting.eigen import quats_and_scales
from mipmap_plugin.splatting.harmonics import C0
from mipmap_plugin.splatting.projection import axes_of

# Target pixels: a difference from black to white in one channel counts as this distance.
CONTRAST = 20.0

# Target pixels: splats at this distance, in position, shape and color together, are not merged; nor are pairs whose cost is above that of
# one pixel of blend weight moved by one pixel. Within both limits objects can be reduced to half of their splats at x1/2 and to a tenth at
# x1/8; a distance of 5 already costs a meadow 0.3 dB.
MAX_DISTANCE = 4.0
MAX_COST = 1.0

# A splat that no view saw gets this fraction of its largest possible weight: almost nothing beside seen splats, but enough to be merged with
# other unseen ones.
UNSEEN_WEIGHT = 1e-6

# A splat's partner is searched among this many next splats along a space-filling curve.
NEIGHBORS = 8

# Splats whose neighbors are compared together, where that is not compiled: each takes a kilobyte or two.
ROWS = 1 << 17

# The fraction of a round's pairs that is merged: the splats of the other pairs may find better partners among the merged ones.
MERGED_PER_ROUND = 0.7

# Merging ends when a round finds fewer pairs than this fraction of the splats.
MIN_PAIRS = 0.002

# Merging down to a count takes pixels up to this many times as large as those of the target.
COARSEST_MERGE = 16.0

# Cells of the space-filling curve lie at -2^19..2^19 on each axis, and are shifted by 2^19..2^20, so that 21 bits suffice.
CELL_RANGE = 2**19

# Opacities stay below 1, whose logit is infinite.
MAX_OPACITY = 0.999


class MergingRounds:
    """The pairs of each round, which are searched once for all fractions that the same splats are merged down to."""

    def __init__(self) -> None:
        self._pairs: list[tuple[Tensor, Tensor]] = []
        self._generator = torch.Generator().manual_seed(0)
        self._ended = False

    def of(self, number: int, splats: _Moments) -> tuple[Tensor, Tensor] | None:
        """The pairs of a round, by rising cost, of which the cheapest are merged; None if there are hardly any. `splats`: those that are left."""
        if number < len(self._pairs):
            first, second = self._pairs[number]
            return first.long(), second.long()
        if self._ended:
            return None
        pairs = splats.pairs(torch.rand(3, generator=self._generator))
        if len(pairs[0]) < MIN_PAIRS * len(splats.weights):
            self._ended = True
            return None
        self._pairs.append((pairs[0].int(), pairs[1].int()))
        return pairs


def merge(gaussians: Gaussians, pixel: Tensor, weights: Tensor, fraction: float, rounds: MergingRounds | None = None) -> tuple[Gaussians, Tensor]:
    """Merge splats down to a `fraction` (0..1) of them; return them and their blend weights [M, P].

    Merging ends early when hardly any pairs are within `MAX_DISTANCE` and `MAX_COST`. `pixel` [N]: the size of a target pixel at each splat,
    in world units. `weights` [N, P]: what each part of the views adds to the blend weight of each splat, in target pixels of a view. `rounds`: of
    an earlier call for the same splats.
    """
    splats, target_count = _Moments.of(gaussians, pixel, weights.sum(1)), max(1, math.floor(fraction * len(gaussians)))
    rows, old_weights, rounds = torch.arange(len(gaussians), device=weights.device), splats.weights, rounds or MergingRounds()
    for number in count_from():
        surplus = len(splats.weights) - target_count
        if surplus <= 0 or (pairs := rounds.of(number, splats)) is None:
            break
        merged = min(surplus, math.ceil(MERGED_PER_ROUND * len(pairs[0])))
        splats, new_rows = splats.merged(pairs[0][:merged], pairs[1][:merged])
        rows = new_rows[rows]
    new_weights = weights.new_zeros(len(splats.weights), weights.shape[1]).index_add_(0, rows, weights)
    return splats.gaussians(gaussians, rows, old_weights), new_weights


def merge_seen(
    gaussians: Gaussians, pixel: Tensor, weights: Tensor, fraction: float, seen: Tensor, rounds: MergingRounds | None = None
) -> tuple[Gaussians, Tensor]:
    """`merge` of the splats that are `seen` [N]; those that no view shows, which would not tell the harm, stay as they are, behind the others."""
    if seen.all():
        return merge(gaussians, pixel, weights, fraction, rounds)
    merged, new_weights = merge(gaussians[seen], pixel[seen], weights[seen], fraction, rounds)
    return merged.joined(gaussians[~seen]), torch.cat([new_weights, weights[~seen]])


def merge_down(gaussians: Gaussians, pixel_of: Callable[[Tensor], Tensor], weights: Tensor, most: int) -> tuple[Gaussians, Tensor]:
    """Merge splats until there are at most `most`; return them and their blend weights.

    Where too few share a pixel, they are merged as at coarser and coarser scales; if too many are left at `COARSEST_MERGE`, those of the
    least blend weight are dropped. `pixel_of`: the size of a target pixel at means [N, 3], [N] in world units. `weights` [N, P]: as in `merge`.
    """
    coarser = 1.0
    while len(gaussians) > most and coarser <= COARSEST_MERGE:
        gaussians, seen = merge(gaussians, coarser * pixel_of(gaussians.means), weights / coarser**2, (most + 0.5) / len(gaussians))
        weights, coarser = seen * coarser**2, coarser * 2**0.5
    if len(gaussians) > most:
        kept = weights.sum(1).topk(most).indices.sort().values
        gaussians, weights = gaussians[kept], weights[kept]
    return gaussians, weights


@dataclass(frozen=True)
class _Moments:
    """The quantities of splats that merging uses, by row."""

    means: Tensor  # [N, 3]
    covariances: Tensor  # [N, 3, 3], double, because differences of thin splats cancel
    depth: Tensor  # [N] optical depth times surface, which is additive: a merged splat has the sum of its pair's
    color: Tensor  # [N, 3] in target pixels
    weights: Tensor  # [N] blend weights, in target pixels
    pixel: Tensor  # [N] world units

    @classmethod
    def of(cls, gaussians: Gaussians, pixel: Tensor, weights: Tensor) -> _Moments:
        """The moments of `gaussians`, whose blend weights are `weights` [N]."""
        parts = in_chunks(lambda chunk: cls._of_chunk(gaussians[chunk], pixel[chunk], weights[chunk]), gaussians.means)
        covariances, depth, color, weights = map(torch.cat, zip(*parts, strict=True))
        return cls(gaussians.means, covariances, depth, color, weights, pixel)

    @staticmethod
    def _of_chunk(gaussians: Gaussians, pixel: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Covariances, depth, color and weights."""
        axes = axes_of(gaussians.quats, gaussians.scales).double()
        covariances = axes @ axes.mT
        depth = -torch.log1p(-gaussians.opacities.clamp_max(MAX_OPACITY)) * _surface(covariances)
        color = CONTRAST * (0.5 + C0 * gaussians.sh[:, 0]).clamp(0, 1)
        unseen = (UNSEEN_WEIGHT * depth / pixel**2).to(weights).clamp_min(torch.finfo(weights.dtype).tiny)
        return covariances, depth, color, weights + unseen

    def pairs(self, shift: Tensor) -> tuple[Tensor, Tensor]:
        """Return pairs of rows that are each other's nearest neighbors, by rising cost. `shift` [3], 0..1, moves the space-filling curve."""
        order = along_curve(self.means, self.pixel.median(), shift)
        means, shapes, color, weights, pixel = (tensor[order] for tensor in (self.means, self.covariances, self.color, self.weights, self.pixel))
        found = nearest_along(means, shapes, color, weights, pixel, reach=NEIGHBORS, limits=(MAX_DISTANCE**2, MAX_COST))
        nearest, least = found or _nearest_along(means, shapes, color, weights, pixel)
        position = torch.arange(len(order), device=order.device)
        first = ((nearest[nearest] == position) & (position < nearest) & least.isfinite()).nonzero()[:, 0]
        first = first[least[first].argsort(stable=True)]
        return order[first], order[nearest[first]]

    def merged(self, first: Tensor, second: Tensor) -> tuple[_Moments, Tensor]:
        """Merge pairs of rows; return the unpaired rows followed by one row per pair, and the new row [N] of each old one."""
        fraction = self.weights[first] / (self.weights[first] + self.weights[second])
        between = (self.means[first] - self.means[second]).double()
        spread = (fraction * (1 - fraction))[:, None, None] * between[:, :, None] * between[:, None, :]

        def mean(values: Tensor) -> Tensor:
            weight = fraction.view(-1, *[1] * (values.dim() - 1)).to(values)
            return weight * values[first] + (1 - weight) * values[second]

        pairs = _Moments(
            mean(self.means), mean(self.covariances) + spread, self.depth[first] + self.depth[second], mean(self.color),
            self.weights[first] + self.weights[second], mean(self.pixel),
        )  # fmt: skip
        unpaired = torch.ones_like(self.weights, dtype=torch.bool).index_fill_(0, torch.cat([first, second]), False)
        rows, kept = unpaired.cumsum(0) - 1, unpaired.nonzero()[:, 0]
        rows[first] = rows[second] = torch.arange(len(first), device=rows.device) + len(kept)
        both = zip(vars(self).values(), vars(pairs).values(), strict=True)
        return _Moments(*(torch.cat([own[kept], merged]) for own, merged in both)), rows

    def gaussians(self, before: Gaussians, rows: Tensor, old_weights: Tensor) -> Gaussians:
        """Return the merged splats. `rows` [N0]: the new row of each splat of `before`. Splats that were not merged stay bit-identical."""
        count = len(self.weights)
        is_merged = rows.bincount(minlength=count) > 1
        if not is_merged.any():
            return before
        origin = torch.zeros_like(rows[:count]).index_copy_(0, rows, torch.arange(len(rows), device=rows.device))
        merged = is_merged.nonzero()[:, 0]

        def replaced(old: Tensor, values: Tensor) -> Tensor:
            return old[origin].index_copy_(0, merged, values.to(old))

        quats, scales, opacities = map(torch.cat, zip(*in_chunks(lambda chunk: self._shapes(merged[chunk]), merged), strict=True))
        return replace(
            before, means=replaced(before.means, self.means[merged]), quats=replaced(before.quats, quats),
            scales=replaced(before.scales, scales), opacities=replaced(before.opacities, opacities),
            sh=self._mean_harmonics(before.sh, rows, old_weights),
        )  # fmt: skip

    def _shapes(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Quaternions [n, 4], scales [n, 3] and opacities [n] of some rows."""
        covariances = self.covariances[rows]
        opacities = -torch.expm1(-self.depth[rows] / _surface(covariances))
        return *quats_and_scales(covariances), opacities.clamp_max(MAX_OPACITY)

    def _mean_harmonics(self, old: Tensor, rows: Tensor, old_weights: Tensor) -> Tensor:
        """The harmonics [N, K, 3] of merged splats, from the `old` ones [N0, K, 3]: each thread sums some of the coefficients."""
        sh, parts = torch.zeros_like(old[: len(self.weights)]), torch.arange(len(rows), device=rows.device).split(CHUNK)

        def add(bands: slice) -> None:
            for part in parts:  # the harmonics are most of the memory
                fraction = old_weights[part] / self.weights[rows[part]]  # 1 for a splat that was not merged
                sh[:, bands].index_add_(0, rows[part], fraction[:, None, None] * old[part, bands])

        count = sh.shape[1]
        share = math.ceil(count / threads.for_views())
        list(threads.side_by_side(add, [slice(start, start + share) for start in range(0, count, share)], threads.for_views()))
        return sh


def _nearest_along(means: Tensor, *further: Tensor) -> tuple[Tensor, Tensor]:
    """What `nearest_along` returns, on any device. Each operation is one for all steps to a neighbor."""
    position = torch.arange(len(means), device=means.device)
    costs = torch.cat([_costs_after(rows, means, *further) for rows in position.split(ROWS)])
    steps = torch.arange(1, NEIGHBORS + 1, device=means.device)
    first = position[:, None] - steps  # of the pairs that end at each splat
    before = torch.where(first < 0, torch.inf, costs.gather(0, first.clamp_min(0)))
    least, number = torch.stack([costs, before], 2).flatten(1).min(1)
    nearest = position + torch.stack([steps, -steps], 1).flatten()[number]
    return nearest.clamp(0, len(means) - 1), least  # where no cost is finite, it may lie beyond the end


def _costs_after(rows: Tensor, means: Tensor, shapes: Tensor, color: Tensor, weights: Tensor, pixel: Tensor) -> Tensor:
    """The cost of merging each of the `rows` [n] with each of the next along the curve, [n, NEIGHBORS]; infinite above a limit and at the end."""
    others = rows[:, None] + torch.arange(1, NEIGHBORS + 1, device=rows.device)
    inside, others, rows = others < len(means), others.clamp_max(len(means) - 1), rows[:, None]
    square = (means[rows] - means[others]).square().sum(2)
    square = square + (shapes[rows] - shapes[others]).flatten(2).norm(dim=2).to(square)
    distance = square / (pixel[rows] * pixel[others]) + (color[rows] - color[others]).square().sum(2)  # squared
    cost = distance * weights[rows] * (weights[others] / (weights[rows] + weights[others]))
    return torch.where(inside & (distance < MAX_DISTANCE**2) & (cost < MAX_COST), cost, torch.inf)


def _surface(covariances: Tensor) -> Tensor:
    """Approximate surface of ellipsoids, up to a factor: [N], the root mean square of their projected areas over all directions.

    For half-axes a, b and c that is the root of a²b² + b²c² + c²a², a sum of minors, so that no eigenvalues are needed.
    """
    minors = [covariances[:, i, i] * covariances[:, j, j] - covariances[:, i, j] ** 2 for i, j in ((0, 1), (0, 2), (1, 2))]
    return sum(minors, torch.zeros_like(minors[0])).clamp_min(torch.finfo(covariances.dtype).tiny).sqrt()


def along_curve(means: Tensor, pixel: Tensor, shift: Tensor) -> Tensor:
    """The order [N] of `means` [N, 3] along a Z-order curve (`morton`).

    Its cells measure a quarter of `pixel`. `shift` [3], 0..1, moves them, because neighbors that one curve separates are close on another.
    """
    center = means.median(dim=0).values

    def place(chunk: slice) -> Tensor:
        cells = (4 * (means[chunk] - center) / pixel).clamp(-CELL_RANGE, CELL_RANGE - 1)
        return morton_codes((cells + CELL_RANGE * (1 + shift.to(cells))).long())

    return torch.cat(in_chunks(place, means)).argsort(stable=True)
