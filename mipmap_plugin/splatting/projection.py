"""EWA projection: 3D Gaussians in the world -> 2D Gaussians on the image plane (Zwicker et al. 2001, as 3DGS uses it)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import FRUSTUM_MARGIN
from mipmap_plugin.splatting.rotations import rotations


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

    def with_axes(self, axes: Tensor) -> Projected:
        """What `project` returns for splats at the same places with other `axes` [N, 3, 3] (`axes_of`)."""
        assert self.to_image is not None
        return Projected(self.means2d, self.depths, *_from_factors(self.to_image @ axes), self.to_image)


def axes_of(quats: Tensor, scales: Tensor) -> Tensor:
    """The axes of splats as columns [N, 3, 3], in world units, from quaternions wxyz [N, 4] and scales [N, 3]."""
    return rotations(quats) * scales[:, None, :]


def project(gaussians: Gaussians, camera: Camera, near: float, frozen_beyond: float = FRUSTUM_MARGIN, axes: Tensor | None = None) -> Projected:
    """Project splats to the image plane. The values of splats nearer than `near` are finite but meaningless.

    `axes` [N, 3, 3]: those of the splats, if they are known (`axes_of`), a third of the time.
    """
    viewmat = camera.viewmat.to(gaussians.means)
    in_camera = camera.to_camera(gaussians.means)
    depths = in_camera[:, 2]
    safe = depths.clamp_min(near)
    slopes = in_camera[:, :2] / safe[:, None]
    focal = slopes.new_tensor([camera.fx, camera.fy])
    means2d = slopes * focal + slopes.new_tensor([camera.cx, camera.cy])
    to_image = _jacobian(slopes, safe, camera, frozen_beyond) @ viewmat[:3, :3]
    if gaussians.covariances is not None:
        shapes = _from_covariances(to_image, gaussians.covariances)
    else:
        shapes = _from_factors(to_image @ (axes_of(gaussians.quats, gaussians.scales) if axes is None else axes))
    return Projected(means2d, depths, *shapes, to_image)


def _jacobian(slopes: Tensor, depths: Tensor, camera: Camera, frozen_beyond: float) -> Tensor:
    """Jacobian of the projection at each center, [N, 2, 3]; slopes are clamped to the frustum widened by `frozen_beyond` on each side."""
    half = slopes.new_tensor([camera.width / camera.fx, camera.height / camera.fy]) / 2
    left = slopes.new_tensor([camera.cx / camera.fx, camera.cy / camera.fy])
    margin = frozen_beyond * half
    u, v = torch.minimum(torch.maximum(slopes, -left - margin), 2 * half - left + margin).unbind(-1)
    per_x, per_y, zero = camera.fx / depths, camera.fy / depths, torch.zeros_like(depths)
    return torch.unflatten(torch.stack([per_x, zero, -per_x * u, zero, per_y, -per_y * v], -1), -1, (2, 3))


def _from_factors(factor: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Covariance entries and determinant of F Fᵀ for F [N, 2, 3].

    The determinant is the sum of F's squared minors (Cauchy-Binet): unlike xx·yy - xy² it cannot become negative when the
    axes of a splat differ by many orders of magnitude.
    """
    first, second = factor.unbind(1)
    det = torch.linalg.cross(first, second).square().sum(-1)
    return first.square().sum(-1), (first * second).sum(-1), second.square().sum(-1), det


def _from_covariances(to_image: Tensor, covariances: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    flat = to_image @ covariances @ to_image.mT
    xx, xy, yy = flat[:, 0, 0], flat[:, 0, 1], flat[:, 1, 1]
    return xx, xy, yy, (xx * yy - xy * xy).clamp_min(0)
