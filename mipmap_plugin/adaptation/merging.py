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

from mipmap_plugin.backends.harmonics import C0
from mipmap_plugin.backends.projection import rotations
from mipmap_plugin.gaussians import Gaussians

# Target pixels: a step from black to white in one channel keeps splats apart as this distance does.
CONTRAST = 20.0

# Target pixels: splats that are this far apart, in place and color together, stay two; and so do those whose merging would cost more than
# one pixel of light that moves by one. Objects come down to half of their splats at x1/2 and to a tenth at x1/8 within both. A meadow at
# x1/4 (flowers) stays at 56 %, and loses nothing; with a distance of 4 it comes down to 37 %, and loses 1.1 dB.
FARTHEST = 3.0
DEAREST = 1.0

# How many of those that follow a splat along the curve through all of them are looked at for a partner.
NEIGHBORS = 8

# Of the pairs that are found at once, the share that is merged: those left over may find a better partner among what the others became.
AT_ONCE = 0.7

# The share of the splats that has to find a partner for another round to pay.
HARDLY_ANY = 0.002

# The curve through all splats has 21 bits an axis. Half of half of that lies on either side of the middle, and the rest is room to shift.
HALF_CURVE = 2**19

# Each spreads the bits that the one before left together, until two zeros follow every bit.
SPREADS = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249))

# No opacity reaches 1, whose logit is infinite.
MOST_OPAQUE = 0.999


def merge(gaussians: Gaussians, pixel: Tensor, light: Tensor, share: float) -> Gaussians:
    """Splats merged until `share` (0..1) of them is left, or hardly any lie within `FARTHEST` of each other and cost less than `DEAREST`.

    `pixel` [N]: the size of a target pixel at each splat, world units. `light` [N]: how many target pixels each fills in a view.
    """
    splats, wanted = _Splats.of(gaussians, pixel, light), max(1, math.floor(share * len(gaussians)))
    generator = torch.Generator().manual_seed(0)
    while (surplus := len(splats.light) - wanted) > 0:
        first, second = splats.pairs(torch.rand(3, generator=generator))
        if len(first) < HARDLY_ANY * len(splats.light):
            break
        most = min(surplus, math.ceil(AT_ONCE * len(first)))
        splats = splats.merged(first[:most], second[:most])
    return splats.gaussians(gaussians)


@dataclass(frozen=True)
class _Splats:
    """Splats as merging sees them, row by row."""

    means: Tensor  # [N, 3]
    covariances: Tensor  # [N, 3, 3], double: thin splats cancel
    depth: Tensor  # [N] optical depth times surface, which is what two splats have as much of as one in their place
    sh: Tensor  # [N, K, 3]
    light: Tensor  # [N]
    pixel: Tensor  # [N]
    row: Tensor  # [N] which splat it was; -1: it is several

    @classmethod
    def of(cls, gaussians: Gaussians, pixel: Tensor, light: Tensor) -> _Splats:
        axes = (rotations(gaussians.quats) * gaussians.scales[:, None, :]).double()
        covariances = axes @ axes.mT
        depth = -torch.log1p(-gaussians.opacities.clamp_max(MOST_OPAQUE)) * _surface(covariances)
        row = torch.arange(len(light), device=light.device)
        light = light.clamp_min(torch.finfo(light.dtype).tiny)
        return cls(gaussians.means, covariances, depth, gaussians.sh, light, pixel, row)

    def pairs(self, shift: Tensor) -> tuple[Tensor, Tensor]:
        """Rows that are each other's nearest, first those whose merging costs least. `shift` [3], 0..1: where the curve begins."""
        order = _curve(self.means, self.pixel.median(), shift)
        means, pixel, light = self.means[order], self.pixel[order], self.light[order]
        color = CONTRAST * (0.5 + C0 * self.sh[order, 0]).clamp(0, 1)
        least, nearest = torch.full_like(light, torch.inf), torch.zeros_like(order)
        place = torch.arange(len(order), device=order.device)
        for step in range(1, min(NEIGHBORS + 1, len(order))):
            one, other = slice(None, -step), slice(step, None)
            apart = (means[one] - means[other]).square().sum(1) / (pixel[one] * pixel[other])
            unlike = apart + (color[one] - color[other]).square().sum(1)
            cost = unlike * light[one] * (light[other] / (light[one] + light[other]))
            cost = torch.where((unlike < FARTHEST**2) & (cost < DEAREST), cost, torch.inf)
            for here, there in ((one, other), (other, one)):
                nearer = cost < least[here]
                nearest[here] = torch.where(nearer, place[there], nearest[here])
                least[here] = torch.where(nearer, cost, least[here])
        first = ((nearest[nearest] == place) & (place < nearest) & least.isfinite()).nonzero()[:, 0]
        first = first[least[first].argsort(stable=True)]
        return order[first], order[nearest[first]]

    def merged(self, first: Tensor, second: Tensor) -> _Splats:
        """One row for each pair, after those that are in none."""
        share = (self.light[first] / (self.light[first] + self.light[second]))[:, None]
        between = self.means[first] - self.means[second]
        spread = share[..., None] * (1 - share[..., None]) * between[:, :, None] * between[:, None, :]
        alone = torch.ones_like(self.light, dtype=torch.bool).index_fill_(0, torch.cat([first, second]), False)

        def mean(values: Tensor) -> Tensor:
            weight = share.view(-1, *[1] * (values.dim() - 1)).to(values)
            return weight * values[first] + (1 - weight) * values[second]

        new = _Splats(
            mean(self.means), mean(self.covariances) + spread, self.depth[first] + self.depth[second], mean(self.sh),
            self.light[first] + self.light[second], mean(self.pixel), torch.full_like(first, -1),
        )  # fmt: skip
        return _Splats(*(torch.cat([getattr(self, field.name)[alone], getattr(new, field.name)]) for field in fields(self)))

    def gaussians(self, before: Gaussians) -> Gaussians:
        """What the splats are now; those in no pair are `before`'s, bit by bit."""
        new = self.row < 0
        if not new.any():
            return before

        def put(old: Tensor, values: Tensor) -> Tensor:
            return old[self.row.clamp_min(0)].masked_scatter(new.view(-1, *[1] * (old.dim() - 1)), values.to(old))

        variances, directions = torch.linalg.eigh(self.covariances[new])
        directions = directions * torch.linalg.det(directions).sign()[:, None, None]  # rotations, not reflections
        opacities = -torch.expm1(-self.depth[new] / _surface(self.covariances[new]))
        return replace(
            before, means=put(before.means, self.means[new]), quats=put(before.quats, _quaternions(directions)),
            scales=put(before.scales, variances.clamp_min(0).sqrt()), opacities=put(before.opacities, opacities.clamp_max(MOST_OPAQUE)),
            sh=put(before.sh, self.sh[new]),
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


def _quaternions(rotation: Tensor) -> Tensor:
    """[N, 4] wxyz of rotations [N, 3, 3], from the largest of its components (Shepperd 1978), so that nothing cancels."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in rotation.unbind(-2))
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], dim=1)
    w, x, y, z = squares.unbind(-1)
    rows = [
        torch.stack([w, zy - yz, xz - zx, yx - xy], dim=1),
        torch.stack([zy - yz, x, yx + xy, xz + zx], dim=1),
        torch.stack([xz - zx, yx + xy, y, zy + yz], dim=1),
        torch.stack([yx - xy, xz + zx, zy + yz, z], dim=1),
    ]
    quats = torch.stack(rows, dim=1)[torch.arange(len(rotation), device=rotation.device), squares.argmax(dim=1)]
    return quats / quats.norm(dim=1, keepdim=True)
