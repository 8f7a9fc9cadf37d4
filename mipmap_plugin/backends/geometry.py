"""Depth and normals on top of any backend: the image is rendered again with colors that encode each splat's depth or direction.

Depths and normals of splats are blended with the weights of the image (alpha times transmittance), so every backend and
screen filter supports them. They are encoded as colors of SH degree 0, which are clamped at 0 below and not above.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from mipmap_plugin.backends import supersample
from mipmap_plugin.backends.base import Backend, Rendered
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects, colorless
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.eigen import eigh3
from mipmap_plugin.splatting.harmonics import C0
from mipmap_plugin.splatting.precision import exact
from mipmap_plugin.splatting.rotations import rotations


def with_outputs(rendered: Rendered, backend: Backend, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
    """`rendered` with the additional `effects.outputs`."""
    outputs, scene = effects.outputs, (backend, gaussians, camera, effects)
    return rendered.replaced(depth=depth(*scene) if "depth" in outputs else None, normals=normals(*scene) if "normals" in outputs else None)


def depth(backend: Backend, gaussians: Gaussians, camera: Camera, effects: Effects) -> Tensor:
    """Depth along the optical axis, [H, W] world units: the mean of the splats' centers, weighted as in the image; 0 where there is no splat."""
    means = exact(gaussians).means
    depths = ((means - camera.center.to(means)) @ camera.viewmat[2, :3].to(means)).to(gaussians.means)
    unit = effects.near_plane or 1.0  # in this unit every depth that is drawn exceeds 1, so that the 0.5 of SH colors costs no digits
    colors = torch.stack([depths / unit, torch.ones_like(depths), torch.ones_like(depths)], -1)
    summed, weight, _ = _blended(backend, gaussians, colors, camera, effects).image.unbind(-1)
    return unit * summed / weight.clamp_min(torch.finfo(weight.dtype).tiny)


def normals(backend: Backend, gaussians: Gaussians, camera: Camera, effects: Effects) -> Tensor:
    """Unit normals in world axes, [H, W, 3]: the mean of the splats' directions, weighted as in the image; 0 where there is no splat."""
    blended = _blended(backend, gaussians, (facing(gaussians, camera) + 1) / 2, camera, effects)
    return normalize(2 * blended.image - blended.alpha[..., None], dim=-1)


def facing(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Each splat's shortest axis, oriented toward the camera: [N, 3] unit, world axes. Arbitrary where the shortest axis is not unique."""
    if gaussians.covariances is None:
        shortest = gaussians.scales.abs().argmin(1)
        axes = rotations(gaussians.quats).mT[torch.arange(len(shortest), device=shortest.device), shortest]
    else:
        finite = gaussians.covariances.isfinite().all(-1).all(-1)[:, None, None]  # the others are not drawn
        axes = eigh3(torch.where(finite, gaussians.covariances, 0.0))[1][..., 0]
    away = (axes * (gaussians.means - camera.center.to(axes))).sum(-1, keepdim=True) > 0
    return torch.where(away, -axes, axes)


def _blended(backend: Backend, gaussians: Gaussians, colors: Tensor, camera: Camera, effects: Effects) -> Rendered:
    """Render with `colors` [N, 3], which are not negative, over black."""
    colored = replace(gaussians, sh=(colors - 0.5)[:, None] / C0)
    return supersample.render(backend, colored, camera, colorless(effects))
