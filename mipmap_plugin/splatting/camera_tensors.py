"""Cameras as tensors on a device: one of them, or several that look at the same splats in as many operations as one takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera

# Where each quantity begins among the numbers of a camera.
ROTATION, CENTER, FOCAL, MIDDLE, SIZE, FIRST, HALF = 0, 9, 12, 14, 16, 18, 20


@dataclass(frozen=True, eq=False)
class CameraTensors:
    """One camera, or V of them, whose tensors have V rows and look at N points as [V, N, ...]."""

    rotation: Tensor  # [3, 3] from the world to the camera
    center: Tensor  # [1, 3] the camera's position in the world
    focal: Tensor  # [1, 2] px
    middle: Tensor  # [1, 2] px: the principal point
    size: Tensor  # [1, 2] px: width and height
    first: Tensor  # [1, 2] slopes x/z and y/z at the picture's left and upper edge
    half: Tensor  # [1, 2] half of the slopes from there to the other edge

    @classmethod
    def of(cls, cameras: Camera | Sequence[Camera], like: Tensor) -> CameraTensors:
        """One camera or several, in a single copy to the device and the dtype of `like`."""
        rows = numbers_of(cameras) if isinstance(cameras, Camera) else [numbers_of(camera) for camera in cameras]
        numbers = torch.tensor(rows, dtype=like.dtype).to(like.device, non_blocking=True)
        rotation, *pairs = numbers.split([9, 3, 2, 2, 2, 2, 2], dim=-1)
        return cls(rotation.unflatten(-1, (3, 3)), *(pair.unsqueeze(-2) for pair in pairs))

    @property
    def mean_focal(self) -> Tensor:
        """[1] px: the geometric mean of both focal lengths."""
        return self.focal.prod(-1).sqrt()

    def to_camera(self, points: Tensor) -> Tensor:
        """`Camera.to_camera`."""
        return (self.rotation @ (points - self.center).mT).mT  # so, and not as a product with few columns, in half the time on a processor

    def in_picture(self, points: Tensor, near: float = 0.0) -> Tensor:
        """`Camera.in_picture`."""
        x, y, z = points.unbind(-1)
        (fx, fy), (cx, cy), (width, height) = (pair.unbind(-1) for pair in (self.focal, self.middle, self.size))
        u, v = fx * x / z + cx, fy * y / z + cy
        inside: Tensor = (z > near) & (u > 0) & (u < width) & (v > 0) & (v < height)
        return inside


def numbers_of(camera: Camera) -> list[float]:
    """The numbers of `CameraTensors`, in the order of its fields."""
    half = camera.width / camera.fx / 2, camera.height / camera.fy / 2
    return [
        *camera.viewmat[:3, :3].flatten().tolist(), *camera.center.tolist(),
        *(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height),
        *(-camera.cx / camera.fx, -camera.cy / camera.fy, *half),
    ]  # fmt: skip
