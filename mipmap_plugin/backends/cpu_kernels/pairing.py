"""The nearest of the next few splats along a curve, for merging (`adaptation.start.merging`)."""

# numba redefines calls and operators.
# mypy: ignore-errors

import math

import numpy as np

from mipmap_plugin.backends.cpu_kernels import inner, kernel
from mipmap_plugin.backends.cpu_kernels.threads import team


def nearest_along(arrays: tuple[np.ndarray, ...], reach: int, max_square: float, max_cost: float) -> tuple[np.ndarray, np.ndarray]:
    """The nearest [N] int64 splat of each among `reach` before and after it, and the cost [N] of that pair; infinite where there is none.

    arrays: of `find_nearest`.
    """
    count = len(arrays[0])
    nearest, least = np.zeros(count, np.int64), np.full(count, np.inf, np.float32)
    team(count).share(find_nearest, count, arrays, reach, np.float32(max_square), np.float32(max_cost), nearest, least)
    return nearest, least


@kernel
def find_nearest(start, stop, arrays, reach, max_square, max_cost, nearest, least):
    """Fill start..stop. arrays, along the curve: means [N, 3], covariances [N, 3, 3], colors [N, 3], weights [N] and pixels [N]."""
    count = len(nearest)
    for i in range(start, stop):
        for step in range(1, reach + 1):
            if i + step < count:
                cost = cost_of(arrays, i, i + step, max_square, max_cost)
                if cost < least[i]:
                    nearest[i], least[i] = i + step, cost
            if i >= step:
                cost = cost_of(arrays, i - step, i, max_square, max_cost)
                if cost < least[i]:
                    nearest[i], least[i] = i - step, cost


@inner
def cost_of(arrays, one, other, max_square, max_cost):
    """The cost of merging two splats; infinite above a limit. `one` comes first on the curve, so that both find the same number."""
    means, covariances, colors, weights, pixel = arrays
    place = color = np.float32(0)
    for k in range(3):
        place += (means[one, k] - means[other, k]) ** 2
        color += (colors[one, k] - colors[other, k]) ** 2
    infinite, area = np.float32(np.inf), pixel[one] * pixel[other]
    if not place / area + color < max_square:  # most pairs: their shapes are not needed
        return infinite
    shape = 0.0
    for j in range(3):
        for k in range(3):
            shape += (covariances[one, j, k] - covariances[other, j, k]) ** 2
    square = (place + np.float32(math.sqrt(shape))) / area + color
    cost = square * weights[one] * (weights[other] / (weights[one] + weights[other]))
    return cost if square < max_square and cost < max_cost else infinite
