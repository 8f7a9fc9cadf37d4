"""Depth and normals on top of any backend: the same image again, with colors that say where each splat lies and which way it faces.

What is blended are the splats' own values with the image's own weights (alpha times what shines through), so that every backend and
screen filter serves them as it is. They go through a color of SH degree 0, which ends at 0 below and nowhere above.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from mipmap_plugin.backends import supersample
from mipmap_plugin.backends.base import Backend, Rendered
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.harmonics import C0
from mipmap_plugin.splatting.rotations import rotations


def beside(rendered: Rendered, backend: Backend, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
    """`rendered` with what `effects.outputs` ask for."""
    asked, shown = effects.outputs, (backend, gaussians, camera, effects)
    return rendered.but(depth=depth(*shown) if "depth" in asked else None, normals=normals(*shown) if "normals" in asked else None)


def depth(backend: Backend, gaussians: Gaussians, camera: Camera, effects: Effects) -> Tensor:
    """[H, W] world units along the optical axis: the mean over what a pixel shows of the splats' centers; 0 where it shows none."""
    along = (gaussians.means - camera.center.to(gaussians.means)) @ camera.viewmat[2, :3].to(gaussians.means)
    unit = effects.near_plane or 1.0  # all that is drawn is at least 1 of it away, so that adding 0.5 rounds off nothing
    colors = torch.stack([along / unit, torch.ones_like(along), torch.ones_like(along)], -1)
    summed, weight, _ = _blended(backend, gaussians, colors, camera, effects).image.unbind(-1)
    return unit * summed / weight.clamp_min(torch.finfo(weight.dtype).tiny)


def normals(backend: Backend, gaussians: Gaussians, camera: Camera, effects: Effects) -> Tensor:
    """[H, W, 3] unit vectors in world axes: the mean direction that what a pixel shows faces; 0 where it shows nothing."""
    blended = _blended(backend, gaussians, (facing(gaussians, camera) + 1) / 2, camera, effects)
    return normalize(2 * blended.image - blended.alpha[..., None], dim=-1)


def facing(gaussians: Gaussians, camera: Camera) -> Tensor:
    """[N, 3] unit, world axes: each splat's shortest axis, turned to the eye. A splat without one, such as a ball, gives any."""
    if gaussians.covariances is None:
        shortest = gaussians.scales.abs().argmin(1)
        axes = rotations(gaussians.quats).mT[torch.arange(len(shortest), device=shortest.device), shortest]
    else:
        sound = gaussians.covariances.isfinite().all(-1).all(-1)[:, None, None]  # the others are not drawn, but would be an error here
        axes = torch.linalg.eigh(torch.where(sound, gaussians.covariances, 0.0)).eigenvectors[..., 0]
    away = (axes * (gaussians.means - camera.center.to(axes))).sum(-1, keepdim=True) > 0
    return torch.where(away, -axes, axes)


def _blended(backend: Backend, gaussians: Gaussians, colors: Tensor, camera: Camera, effects: Effects) -> Rendered:
    """What the image would be with these colors [N, 3], at least 0, over black."""
    colored = replace(gaussians, sh=(colors - 0.5)[:, None] / C0)
    plain = replace(effects, sh_degree=0, background=(0.0, 0.0, 0.0), settings=effects.settings.of_any_color())
    return supersample.render(backend, colored, camera, plain)
