"""The approximate depth order of PlayCanvas on WebGL: a counting sort of splats into buckets of depth.

Source: playcanvas 2.23.3, gsplat-unified-sort-worker and gsplat-sort-bin-weights. Splats of one bucket keep the order of the rows
in memory, which is Morton order.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians

# The depth range of a box around all splats, BOX standard deviations beyond their centers, is cut into BINS bins of equal length.
BOX, BINS = 2, 32

# (distance to the camera's bin in bins, weight): a bin has buckets in proportion to the weight of the first entry whose distance covers it.
WEIGHTS = ((0, 40), (2, 20), (5, 8), (10, 3), (BINS, 1))

# There are 2^b + 1 buckets, b = round(log2(N / 4)) clamped to these bounds.
LEAST_BITS, MOST_BITS = 10, 20

# Bits of the Morton code per axis.
MORTON_BITS = 10


@torch.no_grad()
def ranks(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Rank of each splat front to back, [N] int32. Within a bucket splats are in Morton order, whatever their depth.

    Computed in float64, so that every backend gets the same order. The rank of a splat that is not finite is arbitrary.
    """
    means = gaussians.means.double().nan_to_num(0.0, 0.0, 0.0)
    sizes = gaussians.scales.double().nan_to_num(0.0, 0.0, 0.0).abs().amax(1, keepdim=True)
    if not len(means):
        return torch.zeros(0, dtype=torch.int32, device=means.device)
    eye, forward = camera.center.to(means), camera.viewmat[2, :3].to(means)
    box = torch.stack([(means - BOX * sizes).amin(0), (means + BOX * sizes).amax(0)])
    corners = torch.cartesian_prod(*box.T) - eye
    nearest, farthest = (corners @ forward).aminmax()
    bins = (farthest - (means - eye) @ forward) * BINS / (farthest - nearest).clamp_min(torch.finfo(means.dtype).tiny)
    own = int((farthest / (farthest - nearest) * BINS).nan_to_num().floor().clamp(0, BINS - 1))
    buckets = _buckets(bins, own, len(means))
    order = ((buckets.max() - buckets) << 3 * MORTON_BITS | _morton(means)).argsort(stable=True)
    return torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device=order.device)).int()


def _buckets(bins: Tensor, own: int, count: int) -> Tensor:
    """Bucket of each splat, [N] int64; higher is nearer. `bins` [N] is 0..BINS from farthest to nearest; `own` is the camera's bin."""
    most = 2 ** min(max(round(math.log2(count / 4)), LEAST_BITS), MOST_BITS) + 1
    weights = [next(weight for reach, weight in WEIGHTS if abs(i - own) <= reach) for i in range(BINS)]
    sizes = [max(1, weight * most // sum(weights)) for weight in weights]
    sizes[-1] = max(1, sizes[-1] - max(0, sum(sizes) - most))
    # A splat at the very end of the last bin has a bucket of its own.
    first, count_of = bins.new_tensor([0, *sizes]).cumsum(0), bins.new_tensor([*sizes, 0])
    whole = bins.long().clamp(0, BINS)
    return (first[whole] + count_of[whole] * (bins - whole)).long()


def _morton(means: Tensor) -> Tensor:
    """Morton code of each center, [N] int64: interleaved bits of x, y and z in a grid of 2^MORTON_BITS cells per axis of their bounding box."""
    low, high = means.amin(0), means.amax(0)
    cells = ((means - low) * 2**MORTON_BITS / (high - low).clamp_min(torch.finfo(means.dtype).tiny)).clamp_max(2**MORTON_BITS - 1).long()
    bits = [((cells[:, axis] >> bit) & 1) << (3 * bit + axis) for bit in range(MORTON_BITS) for axis in range(3)]
    return sum(bits, torch.zeros_like(cells[:, 0]))
