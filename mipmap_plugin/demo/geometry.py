"""Intersection of rays with the demo world's two kinds of solids: capsules (a sphere is a capsule of length 0) and a round slab."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

# Ray-capsule pairs tested at once: small enough for the temporaries to stay in the processor's cache.
PAIRS_PER_CHUNK = 1 << 18

# Below this a ray counts as parallel to an axis; the quotient then lies far beyond the capsule's end.
PARALLEL = 1e-7


class Hit(NamedTuple):
    """The nearest intersections of N rays. `distance` is infinite for a ray that hits nothing; its other values are then zero."""

    distance: Tensor  # [N] world units
    normal: Tensor  # [N, 3] unit length, outward
    albedo: Tensor  # [N, 3] linear RGB
    mirror: Tensor  # [N] reflectance at normal incidence, 0..1


def nothing(directions: Tensor) -> Hit:
    """The `Hit` of N rays that hit nothing."""
    n = len(directions)
    return Hit(directions.new_full((n,), math.inf), torch.zeros_like(directions), torch.zeros_like(directions), directions.new_zeros(n))


class Capsules(NamedTuple):
    """K capsules. Each is painted from `color_a` to `color_b`: a gradient along the axis, or that many `bands` of latitude."""

    start: Tensor  # [K, 3]
    axis: Tensor  # [K, 3] unit length
    length: Tensor  # [K]
    radius: Tensor  # [K]
    color_a: Tensor  # [K, 3] linear RGB
    color_b: Tensor  # [K, 3] linear RGB
    bands: Tensor  # [K] 0: gradient
    mirror: Tensor  # [K]

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Center [3] and radius [] of a sphere around all capsules."""
        ends = torch.cat([self.start, self.start + self.axis * self.length[:, None]])
        center = (ends.amin(0) + ends.amax(0)) / 2
        return center, ((ends - center).norm(dim=1) + self.radius.repeat(2)).max()

    def hit(self, origins: Tensor, directions: Tensor, best: Hit) -> None:
        """Update `best` where N rays [N, 3] hit a capsule nearer than `best`."""
        center, radius = self.bounds
        nearest = ((center - origins) * directions).sum(1)  # along the ray, to its point nearest the center
        base = origins + directions * nearest[:, None] - center  # rays start near the capsules: thin ones then survive float32
        reach = (radius**2 - base.square().sum(1)).clamp(min=0).sqrt()
        rays = ((reach > 0) & (nearest + reach > 0) & (nearest - reach < best.distance)).nonzero()[:, 0]
        centered = self._replace(start=self.start - center)
        for part in rays.split(max(1, PAIRS_PER_CHUNK // len(self.radius))):
            distance, index = _nearest_capsule(base[part], directions[part], nearest[part], centered)
            closer = distance < best.distance[part]
            part, distance, index = part[closer], distance[closer], index[closer]
            point = base[part] + directions[part] * (distance - nearest[part])[:, None]
            _paint(best, part, distance, point, Capsules(*(column[index] for column in centered)))


def _nearest_capsule(base: Tensor, directions: Tensor, offset: Tensor, capsules: Capsules) -> tuple[Tensor, Tensor]:
    """Distance [N] from the ray's true origin, `offset` before its base, to the nearest capsule, and which one [N].

    Solves |p - axis point|² = r² for the infinite cylinder, and for the end's sphere where that point lies past an end.
    """
    start, axis, length, radius = capsules.start, capsules.axis, capsules.length, capsules.radius
    along_step = directions @ axis.T  # per unit of distance, how far the ray moves along the axis
    along = base @ axis.T - (start * axis).sum(1)
    toward = (base * directions).sum(1, keepdim=True) - directions @ start.T
    apart = base.square().sum(1, keepdim=True) - 2 * base @ start.T + start.square().sum(1) - radius**2

    a = (1 - along_step**2).clamp_(min=PARALLEL)
    b = toward - along * along_step
    root = b**2 - a * (apart - along**2)
    t = -(b + root.clamp(min=0).sqrt()) / a
    at = along + t * along_step
    end = torch.minimum(at.clamp(min=0), length)

    b_end = toward - end * along_step
    root_end = b_end**2 - (apart - 2 * end * along + end**2)
    body = at == end
    t = torch.where(body, t, -(b_end + root_end.clamp(min=0).sqrt())) + offset[:, None]
    missed = (root < 0) | (~body & (root_end < 0)) | (t <= 0)
    return t.masked_fill_(missed, math.inf).min(dim=1)


def _paint(best: Hit, rays: Tensor, distance: Tensor, point: Tensor, capsules: Capsules) -> None:
    """Write into the rows `rays` [M] of `best` what `capsules`, one per ray, look like at `point` [M, 3]."""
    along = ((point - capsules.start) * capsules.axis).sum(1)
    foot = torch.minimum(along.clamp(min=0), capsules.length)
    normal = torch.nn.functional.normalize(point - capsules.start - capsules.axis * foot[:, None], dim=1)
    gradient = ((along + capsules.radius) / (capsules.length + 2 * capsules.radius)).clamp(0, 1)
    latitude = (normal * capsules.axis).sum(1).clamp(-1, 1).asin() / math.pi + 0.5
    share = torch.where(capsules.bands > 0, (latitude * capsules.bands).floor() % 2, gradient)
    best.distance[rays] = distance
    best.normal[rays] = normal
    best.albedo[rays] = torch.lerp(capsules.color_a, capsules.color_b, share[:, None])
    best.mirror[rays] = capsules.mirror


@dataclass(frozen=True)
class Slab:
    """An upright round slab centered on the z axis whose top, at z = 0, is a checkerboard inside a plain border."""

    radius: float
    thickness: float
    tile: float  # edge of a checker tile
    border: float  # width of the border
    colors: Tensor  # [3, 3] linear RGB: light tile, dark tile, border

    def hit(self, origins: Tensor, directions: Tensor, best: Hit) -> None:
        """Update `best` where N rays [N, 3] hit the slab nearer than `best`: the intersection of the rays' spans between caps and in the side."""
        safe = torch.where(directions.abs() < PARALLEL, PARALLEL, directions)
        caps = torch.stack([-origins[:, 2], -self.thickness - origins[:, 2]]) / safe[:, 2]
        a = safe[:, :2].square().sum(1)
        b = (origins[:, :2] * safe[:, :2]).sum(1)
        root = b**2 - a * (origins[:, :2].square().sum(1) - self.radius**2)
        side = (torch.stack([-root, root]).sign() * root.clamp(min=0).sqrt() - b) / a
        enter = torch.maximum(caps.amin(0), side[0])
        leave = torch.minimum(caps.amax(0), side[1])
        rays = ((root > 0) & (enter < leave) & (enter > 0) & (enter < best.distance)).nonzero()[:, 0]

        point = origins[rays] + directions[rays] * enter[rays, None]
        flat = (caps.amin(0) > side[0])[rays, None]
        up = -directions[rays, 2:].sign() * directions.new_tensor([0.0, 0.0, 1.0])
        best.distance[rays] = enter[rays]
        best.normal[rays] = torch.where(flat, up, point * point.new_tensor([1.0, 1.0, 0.0]) / self.radius)
        best.albedo[rays] = self.colors[self._pattern(point)]
        best.mirror[rays] = 0.0

    def _pattern(self, point: Tensor) -> Tensor:
        tile = (point[:, :2] / self.tile).floor().sum(1).long() % 2
        return torch.where(point[:, :2].norm(dim=1) > self.radius - self.border, 2, tile)
