"""Surfels: flat splats that the rays of the pixels meet, as 2D Gaussian Splatting draws them (Huang et al. 2024, section 4).

A surfel's point (u, v), in standard deviations along its two axes, lies at mean + u·axis_u + v·axis_v (equation 4). With the columns of
X [2, 2] px the images of both axes under the projection's derivative at the mean, and w [2] their depths over the mean's depth z, it is
seen d px from the mean's own image, where (1 + w·(u, v)) d = X (u, v). So the ray through a pixel meets the surfel (equations 8 to 10) at

    (u, v) = q / (1 - w·q)  with  q = X⁻¹ d,  at the depth  z / (1 - w·q);

without w it is the ellipse of an affine projection. What is drawn is the larger of two Gaussians (equation 11), the surfel's own and a
low-pass filter of the screen around a center c:

    alpha = opacity · exp(-min(u² + v², |x - c|² / eps2d) / 2).

The published code takes for c the center of the box around the surfel's ellipse of three deviations, skips a pixel whose ray meets the
plane nearer than the near plane, and loses a surfel whose ellipse reaches behind the eye (diff-surfel-rasterization, forward.cu). So does this.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.projection import Projected
from mipmap_plugin.splatting.rotations import rotations

# Standard deviations: of the ellipse whose box the low-pass filter is centered in.
BOX = 3.0


@dataclass(frozen=True, eq=False)
class Surfels:
    """N surfels as the pixels see them; what `Footprint` is to Gaussians."""

    axes: Tensor  # [N, 2, 2] px: X
    inverse: Tensor  # [N, 2, 2] standard deviations a px: X⁻¹, not finite where there is none
    slopes: Tensor  # [N, 2]: w
    shift: Tensor  # [N, 2] px, from the mean's image to the center of the low-pass filter
    nearness: Tensor  # [N]: near plane over the mean's depth
    opacities: Tensor  # [N]
    width: Tensor  # [N] px², variance of the low-pass filter

    def packed(self) -> Tensor:
        """[N, 11]: what `alpha` needs of each surfel."""
        rest = (self.slopes, self.shift, self.nearness[:, None], self.opacities[:, None], self.width[:, None])
        return torch.cat([self.inverse.flatten(1), *rest], dim=1)

    @staticmethod
    def alpha(packed: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
        """Alpha, not clamped, of surfels [..., 11] at pixels dx, dy px from the centers of their low-pass filters."""
        ux, uy, vx, vy, slope_u, slope_v, shift_x, shift_y, nearness, opacity, width = packed.unbind(-1)
        screen = (dx.square() + dy.square()) / width
        x, y = dx + shift_x, dy + shift_y
        qu, qv = ux * x + uy * y, vx * x + vy * y
        over_depth = 1 - slope_u * qu - slope_v * qv  # the mean's depth over that of the point that is met
        met = (over_depth > 0) & (over_depth * nearness <= 1)
        # Compared before it is divided, so that what is not taken has no gradient, and none that overflows.
        own = met & (qu.square() + qv.square() < screen * over_depth.square())
        qu, qv, over_depth = torch.where(own, qu, 0.0), torch.where(own, qv, 0.0), torch.where(own, over_depth, 1.0)
        squared = torch.where(own, (qu.square() + qv.square()) / over_depth.square(), screen)
        return torch.where(met, opacity * torch.exp(-squared / 2), 0.0)

    def visible(self, min_alpha: Tensor) -> Tensor:
        """[N] bool: finite, bright enough to reach `min_alpha` [N], and with all of its ellipse in front of the eye."""
        finite = torch.isfinite(torch.cat([self.packed(), self.inverse.flatten(1).square()], dim=1)).all(1)
        return finite & (self.opacities >= min_alpha) & (ellipse_box(self.axes, self.slopes, BOX)[2] > 0)

    def extents(self, min_alpha: Tensor) -> Tensor:
        """[N, 2] px, without gradient: half-sizes of boxes around the low-pass centers that hold all with alpha >= `min_alpha` [N].

        Infinite where the ellipse of that alpha reaches behind the eye.
        """
        reach = (2 * (self.opacities / min_alpha).log()).clamp_min(0).sqrt()
        center, half, in_front = ellipse_box(self.axes, self.slopes, reach[:, None])
        own = half + (center - self.shift).abs()
        own = torch.where((in_front > 0)[:, None], own, torch.inf)
        return torch.maximum(own, (reach * self.width.sqrt())[:, None]).detach()


def surfels(gaussians: Gaussians, camera: Camera, effects: Effects) -> tuple[Projected, Surfels]:
    """The surfels of splats, whose third scales are not looked at, and where their low-pass filters are centered.

    Those that are seen edge-on, or that the eye is in, get values that are not `visible`.
    """
    viewmat = camera.viewmat.to(gaussians.means)
    in_camera = (gaussians.means - camera.center.to(viewmat)) @ viewmat[:3, :3].T
    depths = in_camera[:, 2]
    safe = depths.clamp_min(effects.near_plane)
    directions = in_camera[:, :2] / safe[:, None]
    focal, middle = directions.new_tensor([[camera.fx, camera.fy], [camera.cx, camera.cy]])
    tangents = viewmat[:3, :3] @ rotations(gaussians.quats)[:, :, :2]  # [N, 3, 2] unit, in camera axes
    down = tangents[:, 2:] / safe[:, None, None]
    across = focal[:, None] * (tangents[:, :2] / safe[:, None, None] - directions[:, :, None] * down)  # px a world unit
    scales = gaussians.scales[:, None, :2]
    axes, slopes = across * scales, (down * scales)[:, 0]
    shift = ellipse_box(axes, slopes, BOX)[0]
    inverse = _inverse(across) / scales.mT  # so that no size overflows before its time
    width = torch.full_like(depths, effects.eps2d)
    feet = Surfels(axes, inverse, slopes, shift, effects.near_plane / safe, gaussians.opacities, width)
    spread = axes @ axes.mT
    det = torch.linalg.det(axes).square()
    return Projected(directions * focal + middle + shift, depths, spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1], det), feet


def ellipse_box(axes: Tensor, slopes: Tensor, reach: Tensor | float) -> tuple[Tensor, Tensor, Tensor]:
    """The box around the image of a surfel's ellipse of `reach` ([N, 1] or one) deviations.

    Its center [N, 2] and half-size [N, 2] in px from the mean's image, from `axes` X [N, 2, 2] px and `slopes` w [N, 2]; and
    a number [N] that is above 0 where all of the ellipse lies in front of the eye, without which there is no box. The box of a
    conic follows from its dual, X diag(r², r², -1) Xᵀ in homogeneous coordinates.
    """
    squared = reach * reach
    in_front = 1 - squared * slopes.square().sum(1, keepdim=True)
    safe = torch.where(in_front > 0, in_front, 1.0)
    center = -squared * (axes @ slopes[:, :, None])[..., 0] / safe
    half = (center.square() + squared * axes.square().sum(2) / safe).sqrt()
    return center, half, in_front[:, 0]


def _inverse(matrices: Tensor) -> Tensor:
    """Of [N, 2, 2], infinite where there is none."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrices.unbind(1))
    return torch.stack([d, -b, -c, a], -1).unflatten(-1, (2, 2)) / (a * d - b * c)[:, None, None]
