"""EWA projection: 3D Gaussians in the world -> 2D Gaussians on the image plane (Zwicker et al. 2001, as 3DGS uses it)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import USUAL, RenderSettings
from mipmap_plugin.splatting.camera_tensors import FIRST, HALF, CameraTensors, numbers_of
from mipmap_plugin.splatting.rotations import rotations

T = TypeVar("T", Tensor, float)


@dataclass(frozen=True, eq=False)
class Projected:
    """N splats on the image plane, before any screen filter."""

    means2d: Tensor  # [N, 2] px
    depths: Tensor  # [N] world units along the optical axis
    xx: Tensor  # [N] px², entries of the covariance
    xy: Tensor  # [N] px²
    yy: Tensor  # [N] px²
    det: Tensor  # [N] px⁴, never negative
    to_image: Tensor | None = None  # [N, 2, 3] px per world unit: the derivative of the projection at each center, where `project` computed it

    def dilated_det(self, eps2d: float) -> Tensor:
        """[N] px⁴: the determinant of the covariance plus `eps2d` px² along x and y, as xx·yy - xy² without its cancellation."""
        return self.det + eps2d * (self.xx + self.yy) + eps2d**2

    def with_axes(self, axes: Tensor) -> Projected:
        """What `project` returns for splats at the same places with other `axes` [N, 3, 3] (`axes_of`)."""
        assert self.to_image is not None
        return Projected(self.means2d, self.depths, *_from_factors(self.to_image @ axes), self.to_image)


def axes_of(quats: Tensor, scales: Tensor) -> Tensor:
    """The axes of splats as columns [N, 3, 3], in world units, from quaternions wxyz [N, 4] and scales [N, 3]."""
    return rotations(quats) * scales[:, None, :]


def covariances_of(gaussians: Gaussians) -> Tensor:
    """The covariances of splats, [N, 3, 3] world units²: their own, or those of their quaternions and scales."""
    if gaussians.covariances is not None:
        return gaussians.covariances
    axes = axes_of(gaussians.quats, gaussians.scales)
    return axes @ axes.mT


def project(
    gaussians: Gaussians, camera: Camera | CameraTensors, near: float, settings: RenderSettings = USUAL, axes: Tensor | None = None
) -> Projected:
    """Project splats to the image plane. The values of splats nearer than `near` are finite but meaningless.

    `camera`: of several, what is returned has a row for each in front of the others. `axes` [N, 3, 3]: those of the splats, if they are
    known (`axes_of`), a third of the time.
    """
    view = CameraTensors.of(camera, gaussians.means) if isinstance(camera, Camera) else camera
    in_camera = view.to_camera(gaussians.means)
    depths = in_camera[..., 2]
    safe = depths.clamp_min(near)[..., None]
    slopes = in_camera[..., :2] / safe
    means2d = slopes * view.focal + view.middle
    to_image = _jacobian(slopes, safe, view, settings)
    if gaussians.covariances is not None:
        shapes = _from_covariances(to_image, gaussians.covariances)
    else:
        shapes = _from_factors(to_image @ (axes_of(gaussians.quats, gaussians.scales) if axes is None else axes))
    return Projected(means2d, depths, *shapes, to_image)


def slope_limits(camera: Camera, settings: RenderSettings) -> tuple[float, float, float, float]:
    """The least and the greatest slope along x, and those along y, between which the Jacobian is not frozen."""
    numbers = numbers_of(camera)
    (left, right), (top, bottom) = (_limits(numbers[FIRST + k], numbers[HALF + k], numbers[HALF], settings) for k in (0, 1))
    return left, right, top, bottom


def _limits(first: T, half: T, half_width: T, settings: RenderSettings) -> tuple[T, T]:
    """The least and the greatest slope for a picture that begins at `first` and is twice `half` long."""
    beyond = settings.frozen_beyond
    if settings.frozen_by_width:
        return -(1 + beyond) * half_width, (1 + beyond) * half_width
    return first - beyond * half, first + (2 + beyond) * half


def _jacobian(slopes: Tensor, depths: Tensor, view: CameraTensors, settings: RenderSettings) -> Tensor:
    """The derivative of the projection at each center, [..., N, 2, 3]; slopes are clamped to their limits."""
    least, most = _limits(view.first, view.half, view.half[..., :1], settings)
    clamped = torch.minimum(torch.maximum(slopes, least), most)
    across, ahead = view.rotation[..., None, :2, :], view.rotation[..., None, 2:, :]
    return (view.focal / depths)[..., None] * (across - clamped[..., None] * ahead)


def _from_factors(factor: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Covariance entries and determinant of F Fᵀ for F [..., N, 2, 3].

    The determinant is the sum of F's squared minors (Cauchy-Binet): unlike xx·yy - xy² it cannot become negative when the
    axes of a splat differ by many orders of magnitude.
    """
    first, second = factor.unbind(-2)
    det = torch.linalg.cross(first, second).square().sum(-1)
    return first.square().sum(-1), (first * second).sum(-1), second.square().sum(-1), det


def _from_covariances(to_image: Tensor, covariances: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    flat = to_image @ covariances @ to_image.mT
    xx, xy, yy = flat[..., 0, 0], flat[..., 0, 1], flat[..., 1, 1]
    return xx, xy, yy, (xx * yy - xy * xy).clamp_min(0)
