"""The reference backend: pure torch, any device, float32 or float64, exact gradients, in readable steps."""

from __future__ import annotations

import torch
from torch import Tensor

from mipmap_plugin.backends.base import API_VERSION, Capabilities, Needs, Rendered
from mipmap_plugin.backends.compositing import MIN_ALPHA, Splats, composite
from mipmap_plugin.backends.filters import SCREEN_FILTERS, Footprint, footprint
from mipmap_plugin.backends.harmonics import colors
from mipmap_plugin.backends.pixel_integral import PixelIntegral
from mipmap_plugin.backends.projection import Projected, project
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians


class ReferenceBackend:
    """What every other backend is measured against."""

    name = "reference"
    api_version = API_VERSION
    speed = 0
    capabilities = Capabilities(devices=None, dtypes=frozenset({torch.float32, torch.float64}), screen_filters=SCREEN_FILTERS)

    def lacking(self, needs: Needs) -> list[str]:
        return self.capabilities.lacking(needs)

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        with torch.no_grad():
            rows = drawn_rows(gaussians, camera, effects)
        gaussians = gaussians[rows]
        projected, feet = _footprints(gaussians, camera, effects)
        degree = min(effects.sh_degree, gaussians.sh_degree)
        rgb = colors(gaussians.sh, gaussians.means, camera.center.to(gaussians.means), degree)
        color, through = composite(Splats(projected.means2d, feet.packed(), rgb, feet.alpha), extents(feet), camera)
        return Rendered(color + through[..., None] * color.new_tensor(effects.background), 1 - through)


def drawn_rows(gaussians: Gaussians, camera: Camera, effects: Effects) -> Tensor:
    """Indices of the splats that can touch the image, front to back.

    Found first and without gradients, so that a row that is not drawn, however broken, is in no gradient either.
    """
    projected, feet = _footprints(gaussians, camera, effects)
    half = extents(feet)
    low, high = projected.means2d - half, projected.means2d + half
    inside = (high > 0).all(1) & (low < low.new_tensor([camera.width, camera.height])).all(1)
    drawn = finite_rows(gaussians) & (projected.depths > effects.near_plane) & feet.visible(MIN_ALPHA) & inside
    rows = drawn.nonzero()[:, 0]
    return rows[projected.depths[rows].argsort(stable=True)]


def finite_rows(gaussians: Gaussians) -> Tensor:
    """[N] bool: rows whose every number is finite."""
    given = [gaussians.means, gaussians.opacities[:, None], gaussians.sh.flatten(1)]
    shape = [gaussians.quats, gaussians.scales] if gaussians.covariances is None else [gaussians.covariances.flatten(1)]
    return torch.isfinite(torch.cat(given + shape, dim=1)).all(1)


def extents(feet: Footprint | PixelIntegral) -> Tensor:
    """[N, 2] px: the half-sizes of a box around all pixels that each splat can touch."""
    return feet.extents(MIN_ALPHA)


def _footprints(gaussians: Gaussians, camera: Camera, effects: Effects) -> tuple[Projected, Footprint | PixelIntegral]:
    projected = project(gaussians, camera, effects.near_plane)
    return projected, footprint(projected, gaussians.opacities, effects.screen_filter, effects.eps2d)
