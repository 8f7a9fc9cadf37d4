"""The coarse order in which PlayCanvas draws on WebGL: splats sorted into buckets of depth, as many as a counting sort has counters.

Read in playcanvas 2.23.3: gsplat-unified-sort-worker, gsplat-sort-bin-weights, and the order in which a file's rows are kept (Morton's).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians

# The depths of the box around all splats, so many standard deviations beyond their centers, are cut into bins of the same length.
BOX, BINS = 2, 32

# Bins have buckets in proportion to the weight of the first row that lists them: at most so many bins from the camera's own, weight.
WEIGHTS = ((0, 40), (2, 20), (5, 8), (10, 3), (BINS, 1))

# 2 to the power of round(log2(N / 4)) buckets, and one more, with the power in these bounds.
LEAST_BITS, MOST_BITS = 10, 20

# Bits of Morton's order along each axis.
MORTON_BITS = 10


@torch.no_grad()
def ranks(gaussians: Gaussians, camera: Camera) -> Tensor:
    """[N] int32: each splat's place front to back. In one bucket the order is Morton's, wherever the splats lie in it.

    Computed in float64, so that every backend finds the same order. What is not finite has any place.
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
    """[N] int64, the higher the nearer. `bins`: 0..BINS from the farthest to the nearest, of which the camera's is `own`."""
    most = 2 ** min(max(round(math.log2(count / 4)), LEAST_BITS), MOST_BITS) + 1
    weights = [next(weight for reach, weight in WEIGHTS if abs(i - own) <= reach) for i in range(BINS)]
    sizes = [max(1, weight * most // sum(weights)) for weight in weights]
    sizes[-1] = max(1, sizes[-1] - max(0, sum(sizes) - most))
    # What lies at the very end of the last bin has a bucket of its own.
    first, room = bins.new_tensor([0, *sizes]).cumsum(0), bins.new_tensor([*sizes, 0])
    whole = bins.long().clamp(0, BINS)
    return (first[whole] + room[whole] * (bins - whole)).long()


def _morton(means: Tensor) -> Tensor:
    """[N] int64: the bits of x, y and z, each in 2^MORTON_BITS cells of the box of centers, one after the other."""
    low, high = means.amin(0), means.amax(0)
    cells = ((means - low) * 2**MORTON_BITS / (high - low).clamp_min(torch.finfo(means.dtype).tiny)).clamp_max(2**MORTON_BITS - 1).long()
    return sum(((cells[:, axis] >> bit) & 1) << (3 * bit + axis) for bit in range(MORTON_BITS) for axis in range(3))  # type: ignore[return-value]
