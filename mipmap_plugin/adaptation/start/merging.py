"""Fewer, larger splats for a coarser image: of neighbors of like color two become one, those first whose loss shows least.

At x1/8 thousands of splats share a pixel, and a classic renderer dilates every one of them. A pair is replaced by the splat with
the same weight, mean and covariance (moment matching, as in Runnalls 2007, "Kullback-Leibler approach to Gaussian mixture
reduction"), weighed by the light that each shows; the pairs are those that Ward's method takes (1963, "Hierarchical grouping to
optimize an objective function"), many at a time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.eigen import eigh3
from mipmap_plugin.splatting.harmonics import C0
from mipmap_plugin.splatting.rotations import quaternions, rotations

# Target pixels: a step from black to white in one channel keeps splats apart as this distance does.
CONTRAST = 20.0

# Target pixels: splats that are this far apart, in place, shape and color together, stay two; and so do those whose merging would cost
# more than one pixel of light that moves by one. Objects come down to half of their splats at x1/2 and to a tenth at x1/8 within both. A
# meadow at x1/4 (flowers) stays at 56 %, which is as good as all; with a distance of 5 it comes down to 50 %, and loses 0.3 dB.
FARTHEST = 4.0
DEAREST = 1.0

# What no view saw has this share of the light that it could have: that much it weighs beside what was seen, and by that among its like.
UNSEEN = 1e-6

# How many of those that follow a splat along the curve through all of them are looked at for a partner.
NEIGHBORS = 8

# Of the pairs that are found at once, the share that is merged: those left over may find a better partner among what the others became.
AT_ONCE = 0.7

# The share of the splats that has to find a partner for another round to pay.
HARDLY_ANY = 0.002

# Cells of the curve through all splats lie at -2^19..2^19 on each axis, and are shifted by 2^19..2^20: 21 bits hold what comes out.
HALF_CURVE = 2**19

# Each spreads the bits that the one before left together, until two zeros follow every bit.
SPREADS = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249))

# No opacity reaches 1, whose logit is infinite.
MOST_OPAQUE = 0.999


def merge(gaussians: Gaussians, pixel: Tensor, light: Tensor, share: float) -> tuple[Gaussians, Tensor]:
    """Splats merged until `share` (0..1) of them is left, or hardly any lie within `FARTHEST` of each other and cost less than `DEAREST`;
    and how many target pixels each of them fills.

    `pixel` [N]: the size of a target pixel at each splat, world units. `light` [N]: how many target pixels each fills in a view.
    """
    splats, wanted = _Splats.of(gaussians, pixel, light), max(1, math.floor(share * len(gaussians)))
    rows, before = torch.arange(len(gaussians), device=light.device), splats.light
    generator = torch.Generator().manual_seed(0)
    while (surplus := len(splats.light) - wanted) > 0:
        first, second = splats.pairs(torch.rand(3, generator=generator))
        if len(first) < HARDLY_ANY * len(splats.light):
            break
        most = min(surplus, math.ceil(AT_ONCE * len(first)))
        splats, now = splats.merged(first[:most], second[:most])
        rows = now[rows]
    return splats.gaussians(gaussians, rows, before), splats.light


@dataclass(frozen=True)
class _Splats:
    """Splats as merging sees them, row by row."""

    means: Tensor  # [N, 3]
    covariances: Tensor  # [N, 3, 3], double: thin splats cancel
    depth: Tensor  # [N] optical depth times surface, which is what two splats have as much of as one in their place
    color: Tensor  # [N, 3] in target pixels
    light: Tensor  # [N] target pixels
    pixel: Tensor  # [N] world units

    @classmethod
    def of(cls, gaussians: Gaussians, pixel: Tensor, light: Tensor) -> _Splats:
        axes = (rotations(gaussians.quats) * gaussians.scales[:, None, :]).double()
        covariances = axes @ axes.mT
        depth = -torch.log1p(-gaussians.opacities.clamp_max(MOST_OPAQUE)) * _surface(covariances)
        color = CONTRAST * (0.5 + C0 * gaussians.sh[:, 0]).clamp(0, 1)
        unseen = (UNSEEN * depth / pixel**2).to(light).clamp_min(torch.finfo(light.dtype).tiny)
        return cls(gaussians.means, covariances, depth, color, light + unseen, pixel)

    def pairs(self, shift: Tensor) -> tuple[Tensor, Tensor]:
        """Rows that are each other's nearest, first those whose merging costs least. `shift` [3], 0..1: where the curve begins."""
        order = _curve(self.means, self.pixel.median(), shift)
        means, shapes, color, light, pixel = (each[order] for each in (self.means, self.covariances, self.color, self.light, self.pixel))
        least, nearest = torch.full_like(light, torch.inf), torch.zeros_like(order)
        place = torch.arange(len(order), device=order.device)
        for step in range(1, min(NEIGHBORS + 1, len(order))):
            one, other = slice(None, -step), slice(step, None)
            apart = (means[one] - means[other]).square().sum(1)
            apart = apart + (shapes[one] - shapes[other]).flatten(1).norm(dim=1).to(apart)
            unlike = apart / (pixel[one] * pixel[other]) + (color[one] - color[other]).square().sum(1)
            cost = unlike * light[one] * (light[other] / (light[one] + light[other]))
            cost = torch.where((unlike < FARTHEST**2) & (cost < DEAREST), cost, torch.inf)
            for here, there in ((one, other), (other, one)):
                nearer = cost < least[here]
                nearest[here] = torch.where(nearer, place[there], nearest[here])
                least[here] = torch.where(nearer, cost, least[here])
        first = ((nearest[nearest] == place) & (place < nearest) & least.isfinite()).nonzero()[:, 0]
        first = first[least[first].argsort(stable=True)]
        return order[first], order[nearest[first]]

    def merged(self, first: Tensor, second: Tensor) -> tuple[_Splats, Tensor]:
        """One row for each pair, after those that are in none; and the new row [N] of each."""
        share = self.light[first] / (self.light[first] + self.light[second])
        between = (self.means[first] - self.means[second]).double()
        spread = (share * (1 - share))[:, None, None] * between[:, :, None] * between[:, None, :]

        def mean(values: Tensor) -> Tensor:
            weight = share.view(-1, *[1] * (values.dim() - 1)).to(values)
            return weight * values[first] + (1 - weight) * values[second]

        pairs = _Splats(
            mean(self.means), mean(self.covariances) + spread, self.depth[first] + self.depth[second], mean(self.color),
            self.light[first] + self.light[second], mean(self.pixel),
        )  # fmt: skip
        alone = torch.ones_like(self.light, dtype=torch.bool).index_fill_(0, torch.cat([first, second]), False)
        rows = alone.cumsum(0) - 1
        rows[first] = rows[second] = torch.arange(len(first), device=rows.device) + int(alone.sum())
        return _Splats(*(torch.cat([getattr(self, field.name)[alone], getattr(pairs, field.name)]) for field in fields(self))), rows

    def gaussians(self, before: Gaussians, rows: Tensor, light: Tensor) -> Gaussians:
        """What the splats are now; `rows` [N0] tells which of them each of `before`'s went into. One that is alone stays bit by bit."""
        count = len(self.light)
        new = torch.zeros(count, dtype=torch.long, device=rows.device).index_add_(0, rows, torch.ones_like(rows)) > 1
        if not new.any():
            return before
        origin = torch.zeros_like(rows[:count]).index_copy_(0, rows, torch.arange(len(rows), device=rows.device))

        def put(old: Tensor, values: Tensor) -> Tensor:
            return old[origin].masked_scatter(new.view(-1, *[1] * (old.dim() - 1)), values.to(old))

        variances, directions = eigh3(self.covariances[new])
        directions = directions * torch.linalg.det(directions).sign()[:, None, None]  # rotations, not reflections
        opacities = -torch.expm1(-self.depth[new] / _surface(self.covariances[new]))
        share = (light / self.light[rows])[:, None, None]
        sh = torch.zeros_like(before.sh[:count]).index_add_(0, rows, share * before.sh)
        return replace(
            before, means=put(before.means, self.means[new]), quats=put(before.quats, quaternions(directions)),
            scales=put(before.scales, variances.clamp_min(0).sqrt()), opacities=put(before.opacities, opacities.clamp_max(MOST_OPAQUE)),
            sh=put(before.sh, sh[new]),
        )  # fmt: skip


def _surface(covariances: Tensor) -> Tensor:
    """[N] the surface of ellipsoids, up to a factor: the root of the mean square of the areas that they show from all sides.

    For half-axes a, b and c that is the root of a²b² + b²c² + c²a², a sum of minors, so that no axes are needed.
    """
    minors = [covariances[:, i, i] * covariances[:, j, j] - covariances[:, i, j] ** 2 for i, j in ((0, 1), (0, 2), (1, 2))]
    return sum(minors, torch.zeros_like(minors[0])).clamp_min(torch.finfo(covariances.dtype).tiny).sqrt()


def _curve(means: Tensor, pixel: Tensor, shift: Tensor) -> Tensor:
    """[N] the order of `means` [N, 3] along a Z-shaped curve through space (Morton 1966), on which neighbors mostly follow each other.

    Its cells measure a quarter of `pixel`. `shift` [3], 0..1, moves them: neighbors that one curve tears apart follow on another.
    """
    cells = (4 * (means - means.median(dim=0).values) / pixel).clamp(-HALF_CURVE, HALF_CURVE - 1)
    bits = (cells + HALF_CURVE * (1 + shift.to(cells))).long()
    for step, mask in SPREADS:
        bits = (bits | bits << step) & mask
    return (bits[:, 0] | bits[:, 1] << 1 | bits[:, 2] << 2).argsort(stable=True)
