"""The order of `splatting.buckets`: the same ranks as there, in three passes over the splats and a radix sort."""

# numba has no types.
# mypy: ignore-errors

import math

import numpy as np
import torch

from mipmap_plugin.backends.cpu_kernels import inner, kernel
from mipmap_plugin.camera import Camera
from mipmap_plugin.morton import SPREADING
from mipmap_plugin.splatting.buckets import BINS, BOX, MORTON_BITS, depth_scale

# Bits by which keys are sorted at a time: their counts fit a first-level cache.
DIGIT_BITS = 11

CELLS = 1 << MORTON_BITS
TINY = np.finfo(np.float64).tiny


def ranks(means: np.ndarray, scales: np.ndarray, camera: Camera) -> np.ndarray:
    """As `buckets.ranks`, for one camera: [N] int32 for float32 means and scales [N, 3]."""
    found = np.empty(len(means), np.int32)
    if not len(means):
        return found
    box, grid = bounds(means, scales)
    scale = depth_scale(torch.from_numpy(box), len(means), camera)
    eye, forward = camera.center.double().numpy(), camera.viewmat[2, :3].double().numpy()
    firsts, counts = np.array(scale.firsts), np.array([*scale.counts, 0])
    keys = np.empty(len(means), np.int64)
    most = find_keys(means, eye, forward, scale.farthest, scale.range, firsts, counts, grid, keys)
    rank(keys, most, found)
    return found


@kernel
def bounds(means, scales):
    """The least and greatest coordinates of the box around all splats, and of their centers: [2, 3] each."""
    box, grid = np.empty((2, 3)), np.empty((2, 3))
    box[0], box[1], grid[0], grid[1] = np.inf, -np.inf, np.inf, -np.inf
    for i in range(len(means)):
        reach = BOX * max(abs(finite(scales[i, 0])), abs(finite(scales[i, 1])), abs(finite(scales[i, 2])))
        for axis in range(3):
            x = finite(means[i, axis])
            box[0, axis], box[1, axis] = min(box[0, axis], x - reach), max(box[1, axis], x + reach)
            grid[0, axis], grid[1, axis] = min(grid[0, axis], x), max(grid[1, axis], x)
    return box, grid


@kernel
def find_keys(means, eye, forward, farthest, extent, firsts, counts, grid, keys):
    """Write each splat's bucket from the farthest and its Morton code, as one integer; returns the greatest key."""
    spans = np.maximum(grid[1] - grid[0], TINY)
    most = 0
    for i in range(len(means)):
        x, y, z = finite(means[i, 0]), finite(means[i, 1]), finite(means[i, 2])
        depth = (x - eye[0]) * forward[0] + (y - eye[1]) * forward[1] + (z - eye[2]) * forward[2]
        place = (farthest - depth) * BINS / extent
        whole = min(max(int(place), 0), BINS)
        bucket = int(firsts[whole] + counts[whole] * (place - whole))
        code = spread(x, grid[0, 0], spans[0]) | spread(y, grid[0, 1], spans[1]) << 1 | spread(z, grid[0, 2], spans[2]) << 2
        keys[i] = bucket << 3 * MORTON_BITS | code
        most = max(most, keys[i])
    return most


@kernel
def rank(keys, most, ranks):
    """Write the rank of each key by descending bucket and ascending code; of equal keys the earlier comes first."""
    count, codes = len(keys), (1 << 3 * MORTON_BITS) - 1
    nearest = most >> 3 * MORTON_BITS
    order, other, starts = np.arange(count), np.empty(count, np.int64), np.empty((1 << DIGIT_BITS) + 1, np.int64)
    for i in range(count):
        keys[i] = (nearest - (keys[i] >> 3 * MORTON_BITS)) << 3 * MORTON_BITS | keys[i] & codes
    digits = (1 << DIGIT_BITS) - 1
    for shift in range(0, 3 * MORTON_BITS + bit_length(nearest), DIGIT_BITS):
        starts[:] = 0
        for i in range(count):
            starts[(keys[i] >> shift & digits) + 1] += 1
        for digit in range(digits):
            starts[digit + 1] += starts[digit]
        for i in order:
            digit = keys[i] >> shift & digits
            other[starts[digit]] = i
            starts[digit] += 1
        order, other = other, order
    for place in range(count):
        ranks[order[place]] = place


@inner
def finite(value):
    """The value in float64; 0 if it is not finite."""
    return np.float64(value) if math.isfinite(value) else 0.0


@inner
def spread(x, low, span):
    """The bits of the cell of a coordinate, at every third place."""
    bits = int(min((x - low) * CELLS / span, CELLS - 1))
    for shift, kept in SPREADING:
        bits = (bits | bits << shift) & kept
    return bits


@inner
def bit_length(value):
    bits = 0
    while value >> bits:
        bits += 1
    return bits
