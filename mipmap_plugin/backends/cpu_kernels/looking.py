"""What several views show of splats, for the closed form: their areas, and pixel sizes. Torch would write and read a dozen tensors for each view."""

# numba redefines calls and operators.
# mypy: ignore-errors

import math
from collections.abc import Sequence

import numpy as np

from mipmap_plugin.backends.cpu_kernels import inner, kernel
from mipmap_plugin.backends.cpu_kernels.threads import team
from mipmap_plugin.camera import Camera
from mipmap_plugin.render_settings import FRUSTUM_MARGIN
from mipmap_plugin.splatting.camera_tensors import CENTER, FIRST, FOCAL, HALF, MIDDLE, ROTATION, SIZE, numbers_of


def areas(means: np.ndarray, axes: np.ndarray, views: Sequence[Camera], near: float, variance: float) -> np.ndarray:
    """The area of each splat (px² / π), summed over the views that it lies in front of: [N] float64.

    axes: [N, 3, 3], as of `splatting.projection.axes_of`; variance (px²): what the image adds.
    """
    sums = np.zeros(len(means))
    team(len(means)).share(add_areas, len(means), means, axes, _rows(views), float(near), float(variance), sums, of_rows=True)
    return sums


def finest(means: np.ndarray, views: Sequence[Camera], near: float) -> tuple[np.ndarray, np.ndarray]:
    """The size of a pixel at each mean in the closest view that sees it, [N] float32, infinity if none does; and how many views see it, [N]."""
    sizes, seeing = np.full(len(means), np.inf, np.float32), np.zeros(len(means), np.float32)
    team(len(means)).share(find_finest, len(means), means, _rows(views), float(near), sizes, seeing, of_rows=True)
    return sizes, seeing


def _rows(views: Sequence[Camera]) -> np.ndarray:
    return np.array([numbers_of(view) for view in views])


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


@kernel
def find_finest(start, stop, means, views, near, sizes, seeing):
    """Fill start..stop of `finest`."""
    for view in views:
        per_focal = 1 / math.sqrt(view[FOCAL] * view[FOCAL + 1])
        for i in range(start, stop):
            x, y, z = to_camera(view, means, i)
            u, v = view[FOCAL] * x + view[MIDDLE] * z, view[FOCAL + 1] * y + view[MIDDLE + 1] * z  # px, times z
            if z > near and 0 < u < view[SIZE] * z and 0 < v < view[SIZE + 1] * z:
                sizes[i] = min(sizes[i], np.float32(z * per_focal))
                seeing[i] += 1
