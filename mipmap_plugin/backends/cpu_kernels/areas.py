"""The areas of splats on several images, for the closed form. Torch would write and read two dozen tensors for each image."""

# numba redefines calls and operators.
# mypy: ignore-errors

import math
from collections.abc import Sequence

import numpy as np

from mipmap_plugin.backends.cpu_kernels import inner, kernel
from mipmap_plugin.backends.cpu_kernels.threads import team
from mipmap_plugin.camera import Camera
from mipmap_plugin.render_settings import FRUSTUM_MARGIN
from mipmap_plugin.splatting.camera_tensors import CENTER, FIRST, FOCAL, HALF, ROTATION, numbers_of


def areas(means: np.ndarray, axes: np.ndarray, views: Sequence[Camera], near: float, variance: float) -> np.ndarray:
    """The area of each splat (px² / π), summed over the views that it lies in front of: [N] float64.

    axes: [N, 3, 3], as of `splatting.projection.axes_of`; variance (px²): what the image adds.
    """
    cameras, sums = np.array([numbers_of(view) for view in views]), np.zeros(len(means))
    team(len(means)).share(add_areas, len(means), means, axes, cameras, float(near), float(variance), sums, of_rows=True)
    return sums


@kernel
def add_areas(start, stop, means, axes, views, near, variance, sums):
    """Add the areas of the splats start..stop in all views to `sums` [N]."""
    for view in views:
        for i in range(start, stop):
            x, y, z = to_camera(view, means, i)
            if z > near:
                first, second = derivative(view, 0, x / z, z), derivative(view, 1, y / z, z)
                a, b, c = along(first, second, axes, i, 0), along(first, second, axes, i, 1), along(first, second, axes, i, 2)
                trace, det = 0.0, 0.0
                for u, v in (a, b, c):
                    trace += u * u + v * v
                for one, other in ((a, b), (b, c), (c, a)):
                    det += (one[0] * other[1] - one[1] * other[0]) ** 2
                sums[i] += math.sqrt(det + variance * trace + variance * variance)


@inner
def to_camera(view, means, i):
    """`CameraTensors.to_camera` of a mean."""
    x, y, z = means[i, 0] - view[CENTER], means[i, 1] - view[CENTER + 1], means[i, 2] - view[CENTER + 2]
    return row_of(view, 0, x, y, z), row_of(view, 3, x, y, z), row_of(view, 6, x, y, z)


@inner
def row_of(view, k, x, y, z):
    return view[ROTATION + k] * x + view[ROTATION + k + 1] * y + view[ROTATION + k + 2] * z


@inner
def derivative(view, k, slope, z):
    """Row k of the derivative of the projection, as `splatting.projection`'s."""
    first, half, scale = view[FIRST + k], view[HALF + k], view[FOCAL + k] / z
    clamped = min(max(slope, first - FRUSTUM_MARGIN * half), first + (2 + FRUSTUM_MARGIN) * half)
    across, ahead = ROTATION + 3 * k, ROTATION + 6
    return (
        scale * (view[across] - clamped * view[ahead]),
        scale * (view[across + 1] - clamped * view[ahead + 1]),
        scale * (view[across + 2] - clamped * view[ahead + 2]),
    )


@inner
def along(first, second, axes, i, k):
    """Axis k of a splat on the image, px."""
    x, y, z = axes[i, 0, k], axes[i, 1, k], axes[i, 2, k]
    return first[0] * x + first[1] * y + first[2] * z, second[0] * x + second[1] * y + second[2] * z
