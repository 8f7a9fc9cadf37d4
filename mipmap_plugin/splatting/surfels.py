"""Surfels: flat splats that are intersected with the rays of the pixels, as in 2D Gaussian Splatting (Huang et al. 2024, section 4).

A surfel's point (u, v), in standard deviations along its two axes, lies at mean + u·axis_u + v·axis_v (equation 4). Let the columns of
X [2, 2] px be the images of both axes under the Jacobian of the projection at the mean, and w [2] the axes' depths divided by the mean's
depth z. The point's image lies d px from the mean's, where (1 + w·(u, v)) d = X (u, v). So the ray through a pixel intersects the surfel
(equations 8 to 10) at

    (u, v) = q / (1 - w·q)  with  q = X⁻¹ d,  at the depth  z / (1 - w·q);

with w = 0 this is the ellipse of an affine projection. Alpha is the larger of two Gaussians (equation 11), the surfel's own and a
low-pass filter on the screen around a center c:

    alpha = opacity · exp(-min(u² + v², |x - c|² / eps2d) / 2).

As in the published code (diff-surfel-rasterization, forward.cu), c is the center of the box around the surfel's ellipse of three standard
deviations, a pixel whose ray intersects the plane in front of the near plane is skipped, and a surfel whose ellipse reaches behind the
eye is not drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.rotations import rotations

# Standard deviations: size of the ellipse whose bounding box gives the center of the low-pass filter.
BOX = 3.0


@dataclass(frozen=True, eq=False)
class Surfels:
    """N surfels on the image. Has the methods of `filters.Footprint`."""

    axes: Tensor  # [N, 2, 2] px: X
    inverse: Tensor  # [N, 2, 2] standard deviations per px: X⁻¹, not finite where X is singular
    slopes: Tensor  # [N, 2]: w
    shift: Tensor  # [N, 2] px, from the mean's image to the center of the low-pass filter
    nearness: Tensor  # [N]: near plane ÷ the mean's depth
    opacities: Tensor  # [N]
    width: Tensor  # [N] px², variance of the low-pass filter

    def packed(self) -> Tensor:
        """The parameters of `alpha`, [N, 11]."""
        rest = (self.slopes, self.shift, self.nearness[:, None], self.opacities[:, None], self.width[:, None])
        return torch.cat([self.inverse.flatten(1), *rest], dim=1)

    @staticmethod
    def alpha(packed: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
        """Alpha of surfels [..., 11] at pixels dx, dy px from the centers of their low-pass filters, not clamped."""
        ux, uy, vx, vy, slope_u, slope_v, shift_x, shift_y, nearness, opacity, width = packed.unbind(-1)
        screen = (dx.square() + dy.square()) / width
        x, y = dx + shift_x, dy + shift_y
        qu, qv = ux * x + uy * y, vx * x + vy * y
        over_depth = 1 - slope_u * qu - slope_v * qv  # the mean's depth ÷ the intersection's
        hit = (over_depth > 0) & (over_depth * nearness <= 1)
        # Compared before the division, so that the branch that is not taken has no gradient that could overflow.
        own = hit & (qu.square() + qv.square() < screen * over_depth.square())
        qu, qv, over_depth = torch.where(own, qu, 0.0), torch.where(own, qv, 0.0), torch.where(own, over_depth, 1.0)
        squared = torch.where(own, (qu.square() + qv.square()) / over_depth.square(), screen)
        return torch.where(hit, opacity * torch.exp(-squared / 2), 0.0)

    def visible(self, min_alpha: Tensor) -> Tensor:
        """Which surfels are finite, reach `min_alpha` [N], and have their whole ellipse in front of the eye, [N] bool."""
        finite = torch.isfinite(torch.cat([self.packed(), self.inverse.flatten(1).square()], dim=1)).all(1)
        return finite & (self.opacities >= min_alpha) & (ellipse_box(self.axes, self.slopes, BOX)[2] > 0)

    def extents(self, min_alpha: Tensor) -> Tensor:
        """Half-sizes of boxes around the low-pass centers that contain all pixels with alpha >= `min_alpha` [N]; [N, 2] px, without gradient.

        Infinite where the ellipse of that alpha reaches behind the eye.
        """
        reach = (2 * (self.opacities / min_alpha).log()).clamp_min(0).sqrt()
        center, half, in_front = ellipse_box(self.axes, self.slopes, reach[:, None])
        own = half + (center - self.shift).abs()
        own = torch.where((in_front > 0)[:, None], own, torch.inf)
        return torch.maximum(own, (reach * self.width.sqrt())[:, None]).detach()


def surfels(gaussians: Gaussians, camera: Camera, effects: Effects) -> tuple[Tensor, Tensor, Surfels]:
    """The centers of the low-pass filters, [N, 2] px; the depths, [N]; and the surfels of splats, whose third scales are ignored.

    Surfels that are seen edge-on, or contain the eye, get values that are not `visible`.
    """
    viewmat = camera.viewmat.to(gaussians.means)
    in_camera = (gaussians.means - camera.center.to(viewmat)) @ viewmat[:3, :3].T
    depths = in_camera[:, 2]
    safe = depths.clamp_min(effects.near_plane)
    directions = in_camera[:, :2] / safe[:, None]
    focal, middle = directions.new_tensor([[camera.fx, camera.fy], [camera.cx, camera.cy]])
    tangents = viewmat[:3, :3] @ rotations(gaussians.quats)[:, :, :2]  # [N, 3, 2] unit, in camera axes
    down = tangents[:, 2:] / safe[:, None, None]
    across = focal[:, None] * (tangents[:, :2] / safe[:, None, None] - directions[:, :, None] * down)  # px per world unit
    scales = gaussians.scales[:, None, :2]
    axes, slopes = across * scales, (down * scales)[:, 0]
    shift = ellipse_box(axes, slopes, BOX)[0]
    inverse = _inverse(across) / scales.mT  # inverted before the scales, whose product could overflow or vanish
    width = torch.full_like(depths, effects.eps2d)
    footprints = Surfels(axes, inverse, slopes, shift, effects.near_plane / safe, gaussians.opacities, width)
    return directions * focal + middle + shift, depths, footprints


def ellipse_box(axes: Tensor, slopes: Tensor, reach: Tensor | float) -> tuple[Tensor, Tensor, Tensor]:
    """The bounding box of the image of a surfel's ellipse of `reach` ([N, 1] or a number) standard deviations.

    From `axes` X [N, 2, 2] px and `slopes` w [N, 2]: center [N, 2] and half-size [N, 2] in px from the mean's image, and a number [N]
    that is positive where the whole ellipse lies in front of the eye; elsewhere there is no box. The box of a conic follows from
    its dual, X diag(r², r², -1) Xᵀ in homogeneous coordinates.
    """
    squared = reach * reach
    in_front = 1 - squared * slopes.square().sum(1, keepdim=True)
    safe = torch.where(in_front > 0, in_front, 1.0)
    center = -squared * (axes @ slopes[:, :, None])[..., 0] / safe
    half = (center.square() + squared * axes.square().sum(2) / safe).sqrt()
    return center, half, in_front[:, 0]


def _inverse(matrices: Tensor) -> Tensor:
    """Inverses of [N, 2, 2], not finite for singular matrices."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrices.unbind(1))
    return torch.unflatten(torch.stack([d, -b, -c, a], -1), -1, (2, 2)) / (a * d - b * c)[:, None, None]
