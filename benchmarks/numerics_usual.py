"""Usual formulas of the field, a few lines each, for comparison. Each names its source; none is copied."""

from __future__ import annotations

import torch
from torch import Tensor

from mipmap_plugin.backends.base import Rendered
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import FRUSTUM_MARGIN, MAX_ALPHA
from mipmap_plugin.splatting.harmonics import colors
from mipmap_plugin.splatting.rotations import rotations

# What diff-gaussian-rasterization adds to det² in the gradient of a covariance (backward.cu).
PUBLISHED_GUARD = 1e-7


class UsualFormulas:
    """3DGS's classic formulas in the order in which they are published, every splat at every pixel, as torch differentiates them."""

    name = "usual formulas"

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        viewmat = camera.viewmat.to(gaussians.means)
        place = gaussians.means @ viewmat[:3, :3].T + viewmat[:3, 3]  # rotate, then shift: cancels far from the origin
        order = place[:, 2].detach().argsort(stable=True)
        order = order[place[order, 2] > effects.near_plane]
        place, gaussians = place[order], gaussians[order]
        z = place[:, 2]
        center = torch.stack([camera.fx * place[:, 0] / z + camera.cx, camera.fy * place[:, 1] / z + camera.cy], -1)
        covariance = flattened(gaussians, place, camera) + effects.eps2d * torch.eye(2).to(center)
        xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
        det = xx * yy - xy * xy  # cancels for needles
        gap = pixels(camera, center) - center
        dx, dy = gap[..., 0], gap[..., 1]
        power = -(yy / det * dx**2 + xx / det * dy**2) / 2 + xy / det * dx * dy
        alpha = (gaussians.opacities * power.exp()).clamp_max(MAX_ALPHA)
        alpha = torch.where((power <= 0) & (det != 0) & (alpha >= effects.settings.min_alpha), alpha, 0.0)
        after = torch.cumprod(1 - alpha, -1)
        before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], -1)
        weights = torch.where(after >= effects.settings.min_transmittance, before * alpha, 0.0)
        rgb = colors(gaussians.sh, gaussians.means, camera.center.to(center), effects.sh_degree)
        through = 1 - weights.sum(-1)
        image = weights @ rgb + through[:, None] * rgb.new_tensor(effects.background)
        return Rendered(image.view(*camera.size, 3), (1 - through).view(camera.size))


def flattened(gaussians: Gaussians, place: Tensor, camera: Camera) -> Tensor:
    """[N, 2, 2] px²: J W Σ Wᵀ Jᵀ, with Σ computed first."""
    half = place.new_tensor([camera.width / camera.fx, camera.height / camera.fy]) / 2 * (1 + FRUSTUM_MARGIN)
    u, v = (place[:, :2] / place[:, 2:]).clamp(-half, half).unbind(-1)
    zero, z = torch.zeros_like(u), place[:, 2]
    jacobian = torch.stack([camera.fx / z, zero, -camera.fx * u / z, zero, camera.fy / z, -camera.fy * v / z], -1).unflatten(-1, (2, 3))
    factor = rotations(gaussians.quats) * gaussians.scales[:, None]
    turn = jacobian @ camera.viewmat[:3, :3].to(place)
    return turn @ (factor @ factor.mT) @ turn.mT


def pixels(camera: Camera, like: Tensor) -> Tensor:
    """[P, 1, 2] px, the centers."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    return torch.stack([x, y], -1).flatten(0, 1)[:, None].to(like)


def published_gradient_share(det: Tensor) -> Tensor:
    """What 1/(det² + 1e-7) leaves of a gradient that ought to have 1/det²."""
    return det**2 / (det**2 + PUBLISHED_GUARD)


def gsplat_compensation_slope(ratio: Tensor, floor: float) -> Tensor:
    """The slope that gsplat 1.6 returns for max(sqrt(ratio), floor): also below the floor, where the value is constant."""
    return 0.5 / (ratio.sqrt().clamp_min(floor) + 1e-6)


def mip_compensation(det: Tensor, eps2d: float) -> Tensor:
    """Mip-Splatting's compensation of a round splat's opacity: 0 where det is 1e-6 px⁴ or less."""
    variance = det.sqrt()
    compensation = ((det / ((variance + eps2d) ** 2 + 1e-6)) + 1e-6).sqrt()
    return torch.where(det <= 1e-6, 0.0, compensation)


def unnormalized_axes(quats: Tensor) -> Tensor:
    """[N, 3, 3]: what the kernel of 3DGS takes for a rotation, from quaternions that it does not normalize."""
    w, x, y, z = quats.unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
