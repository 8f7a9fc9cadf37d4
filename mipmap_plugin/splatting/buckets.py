"""The approximate depth order of most viewers in a browser: a counting sort of splats into buckets of depth.

Sources: playcanvas 2.23.3, gsplat-unified-sort-worker and gsplat-sort-bin-weights; @babylonjs/core 9.35.0, gaussianSplattingSortWorker;
three 0.187.0, GaussianSplat and CountingSort; antimatter15/splat ba182b5, runSort, of which those of gsplat.js, GaussianSplats3D, viser and
aframe-gaussian-splatting are versions. Splats of one bucket keep the order of the rows in memory, which in PlayCanvas is Morton order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.morton import morton_codes
from mipmap_plugin.render_settings import EvenBuckets, RenderSettings
from mipmap_plugin.splatting.rotations import rotations

# The depth range of a box around all splats, BOX standard deviations beyond their centers, is cut into BINS bins of equal length.
BOX, BINS = 2, 32

# Standard deviations along x, y or z, whichever are most, by which three.js's sphere around all splats lies beyond their centers.
SPHERE = 2

# (distance to the camera's bin in bins, weight): a bin has buckets in proportion to the weight of the first entry whose distance covers it.
WEIGHTS = ((0, 40), (2, 20), (5, 8), (10, 3), (BINS, 1))

# There are 2^b + 1 buckets, b = round(log2(N / 4)) clamped to these bounds.
LEAST_BITS, MOST_BITS = 10, 20

# Bits of the Morton code per axis.
MORTON_BITS = 10


@torch.no_grad()
def ranks(gaussians: Gaussians, cameras: Sequence[Camera]) -> list[Tensor]:
    """For each camera, the rank of each splat front to back, [N] int32. Within a bucket splats are in Morton order, whatever their depth.

    Computed in float64, so that every backend gets the same order. The rank of a splat that is not finite is arbitrary. What does not depend on
    the cameras is found once, and a GPU is waited for once.
    """
    means = gaussians.means.double().nan_to_num(0.0, 0.0, 0.0)
    sizes = gaussians.scales.double().nan_to_num(0.0, 0.0, 0.0).abs().amax(1, keepdim=True)
    if not len(means):
        return [torch.zeros(0, dtype=torch.int32, device=means.device) for _ in cameras]
    box = torch.stack([(means - BOX * sizes).amin(0), (means + BOX * sizes).amax(0)]).cpu()
    buckets = [_buckets(means, depth_scale(box, len(means), camera), camera) for camera in cameras]
    codes = _morton(means)
    return [_places(((own.max() - own) << 3 * MORTON_BITS | codes).argsort(stable=True)) for own in buckets]


def _buckets(means: Tensor, scale: DepthScale, camera: Camera) -> Tensor:
    """The bucket of each center, [N] int64; higher is nearer."""
    depths = ((means - camera.center.to(means)) * camera.viewmat[2, :3].to(means)).sum(1)
    bins = (scale.farthest - depths) * BINS / scale.range
    # A splat at the very end of the last bin has a bucket of its own.
    first, count_of = means.new_tensor(scale.firsts), means.new_tensor([*scale.counts, 0])
    whole = bins.long().clamp(0, BINS)
    return (first[whole] + count_of[whole] * (bins - whole)).long()


@torch.no_grad()
def even_ranks(gaussians: Gaussians, camera: Camera, even: EvenBuckets) -> Tensor:
    """As `ranks`, for one camera, by buckets that divide a range of depths evenly."""
    means = gaussians.means.double().nan_to_num(0.0, 0.0, 0.0)
    if not len(means):
        return torch.zeros(0, dtype=torch.int32, device=means.device)
    depths = (means - camera.center.to(means)) @ camera.viewmat[2, :3].to(means)
    nearest, farthest = depths.aminmax() if even.sphere_from is None else _sphere(gaussians, camera, even.sphere_from)
    steps = 2 ** bucket_bits(len(means)) if even.steps is None else even.steps
    extent = (farthest - nearest).clamp_min(torch.finfo(means.dtype).tiny)
    buckets = ((depths - nearest) * (steps / extent)).clamp(0, steps).int()
    rows = torch.arange(len(means), device=means.device)
    if even.largest_first:
        rows = (gaussians.scales.double().prod(1) * gaussians.opacities.double()).argsort(stable=True, descending=True)
    rows = rows.flip(0) if even.later_in_front else rows  # those of a bucket, from the front
    return _places(rows[buckets[rows].argsort(stable=True)])


def _places(order: Tensor) -> Tensor:
    """The place of each row in an order of rows [N], int32."""
    return torch.empty_like(order, dtype=torch.int32).scatter_(0, order, torch.arange(len(order), dtype=torch.int32, device=order.device))


def _sphere(gaussians: Gaussians, camera: Camera, least: float) -> tuple[Tensor, Tensor]:
    """Depths of the nearest and the farthest point of three.js's sphere around all splats, the nearest at least `least`."""
    means, quats, scales = (part.nan_to_num(0.0, 0.0, 0.0) for part in (gaussians.means.double(), gaussians.quats, gaussians.scales))
    variances = (rotations(quats).square() @ scales.square()[:, :, None])[:, :, 0]  # along x, y and z
    reach = SPHERE * variances.amax(1, keepdim=True).sqrt().double()
    middle = ((means - reach).amin(0) + (means + reach).amax(0)) / 2
    radius = ((means - middle).norm(dim=1, keepdim=True) + reach).max()
    depth = (middle - camera.center.to(means)) @ camera.viewmat[2, :3].to(means)
    return (depth - radius).clamp_min(least), depth + radius


def ranks_of_views(gaussians: Gaussians, shots: Sequence[tuple[Camera, Effects]]) -> list[Tensor | None]:
    """For each view, the ranks by the buckets of its settings; None if its splats are sorted exactly."""
    bucketed = [camera for camera, effects in shots if effects.settings.bucketed]
    found = iter(ranks(gaussians, bucketed) if bucketed else [])

    def of(camera: Camera, settings: RenderSettings) -> Tensor | None:
        if settings.bucketed:
            return next(found)
        return even_ranks(gaussians, camera, settings.even_buckets) if settings.even_buckets else None

    return [of(camera, effects.settings) for camera, effects in shots]


def bucket_bits(count: int) -> int:
    """b, for `count` splats in 2^b + 1 buckets."""
    return min(max(round(math.log2(count / 4)), LEAST_BITS), MOST_BITS)


class DepthScale(NamedTuple):
    """The bins of a view, from the farthest to the nearest, and the buckets of each."""

    farthest: float  # depth, in world units
    range: float  # from the nearest depth to the farthest
    firsts: list[int]  # [BINS + 1]: the first bucket of each bin; higher is nearer
    counts: list[int]  # [BINS]: how many buckets it has


def depth_scale(box: Tensor, count: int, camera: Camera) -> DepthScale:
    """The bins and buckets for `count` splats in `box` [2, 3], the least and the greatest coordinates, in float64."""
    corners = torch.cartesian_prod(*box.T) - camera.center.to(box)
    nearest, farthest = map(float, (corners @ camera.viewmat[2, :3].to(box)).aminmax())
    extent = max(farthest - nearest, torch.finfo(box.dtype).tiny)
    own = int(min(max(farthest / extent * BINS, 0), BINS - 1))  # the camera's bin
    most = 2 ** bucket_bits(count) + 1
    weights = [next(weight for reach, weight in WEIGHTS if abs(i - own) <= reach) for i in range(BINS)]
    counts = [max(1, weight * most // sum(weights)) for weight in weights]
    counts[-1] = max(1, counts[-1] - max(0, sum(counts) - most))
    return DepthScale(farthest, extent, [0, *accumulate(counts)], counts)


def _morton(means: Tensor) -> Tensor:
    """Morton code of each center, [N] int64, in a grid of 2^MORTON_BITS cells per axis of their bounding box."""
    low, high = means.amin(0), means.amax(0)
    cells = ((means - low) * 2**MORTON_BITS / (high - low).clamp_min(torch.finfo(means.dtype).tiny)).clamp_max(2**MORTON_BITS - 1).long()
    return morton_codes(cells)
