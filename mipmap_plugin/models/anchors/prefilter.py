"""The voxel prefilter of anchor models: which anchors are decoded for a camera. The original's culling in pure torch."""

from __future__ import annotations

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import NEAR_PLANE
from mipmap_plugin.render_settings import FRUSTUM_MARGIN
from mipmap_plugin.screen_filters import DILATION

TILE = 16  # px: the original renders in tiles of this size, and an anchor that touches the outermost tile is in view

LEAST_ROOT = 0.1  # px⁴: the least value of the root's square in the original, by which nearly round anchors count as a little larger


@torch.no_grad()
def in_view(means: Tensor, scales: Tensor, quats: Tensor, camera: Camera) -> Tensor:
    """Which anchors' ellipses of three standard deviations touch a tile of the image, [N] bool.

    `means` [N, 3], `scales` [N, 3] (lengths) and unit `quats` [N, 4] wxyz are the anchors' own, in world units.
    """
    viewmat = camera.viewmat.to(means)
    x, y, z = camera.to_camera(means).unbind(-1)
    depth = z.clamp_min(NEAR_PLANE)
    u, v = x / depth, y / depth
    radius = _radius(_axes(scales, quats) @ viewmat[:3, :3].T, u, v, depth, camera)
    # The original's pixel centers lie at integers; on the far sides, whole tiles count although they extend beyond the border.
    right, down = camera.fx * u + camera.cx - 0.5, camera.fy * v + camera.cy - 0.5
    far_x, far_y = (TILE * -(-side // TILE) for side in (camera.width, camera.height))
    return (z > NEAR_PLANE) & (right + radius >= 1) & (right - radius < far_x) & (down + radius >= 1) & (down - radius < far_y)


def _axes(scales: Tensor, quats: Tensor) -> Tensor:
    """The axes of each ellipsoid, rotated by its quaternion, as rows [N, 3, 3]."""
    axes = torch.diag_embed(scales)
    w, xyz = quats[:, None, :1], quats[:, None, 1:].expand_as(axes)
    turned: Tensor = torch.linalg.cross(xyz, axes)
    rotated: Tensor = axes + 2 * (w * turned + torch.linalg.cross(xyz, turned))
    return rotated


def _radius(axes: Tensor, u: Tensor, v: Tensor, depth: Tensor, camera: Camera) -> Tensor:
    """Three standard deviations along the longer axis of the dilated ellipse, rounded up, [N] px."""
    u = _clamped(u, camera.cx / camera.fx, camera.width / camera.fx)
    v = _clamped(v, camera.cy / camera.fy, camera.height / camera.fy)
    across = camera.fx / depth[:, None] * (axes[..., 0] - u[:, None] * axes[..., 2])
    along = camera.fy / depth[:, None] * (axes[..., 1] - v[:, None] * axes[..., 2])
    xx, yy = across.square().sum(1) + DILATION, along.square().sum(1) + DILATION
    xy = (across * along).sum(1)
    longest = (xx + yy) / 2 + (((xx - yy) / 2).square() + xy.square()).clamp_min(LEAST_ROOT).sqrt()
    return (3 * longest.sqrt()).ceil()


def _clamped(slope: Tensor, left: float, whole: float) -> Tensor:
    """Clamp slopes to the widened frustum. `left`: minus the slope of the image's left edge; `whole`: the slope of its width."""
    margin = FRUSTUM_MARGIN * whole / 2
    return slope.clamp(-left - margin, whole - left + margin)
