"""The reference backend: pure torch, any device, float32 or float64, exact gradients, in readable steps."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mipmap_plugin.backends.base import API_VERSION, SETTINGS, Capabilities, Needs, Rendered
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import SURFEL, Effects, RenderSettings
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting import buckets
from mipmap_plugin.splatting.compositing import Splats, alone, composite
from mipmap_plugin.splatting.filters import SCREEN_FILTERS, Footprint, footprint
from mipmap_plugin.splatting.harmonics import colors
from mipmap_plugin.splatting.packing import in_steps, packed
from mipmap_plugin.splatting.pixel_integral import PixelIntegral
from mipmap_plugin.splatting.projection import Projected, project
from mipmap_plugin.splatting.surfels import Surfels, surfels
from mipmap_plugin.splatting.window import WindowIntegral


class ReferenceBackend:
    """What every other backend is measured against."""

    name = "reference"
    api_version = API_VERSION
    speed = 0
    capabilities = Capabilities(None, frozenset({torch.float32, torch.float64}), SCREEN_FILTERS | {SURFEL}, settings=frozenset(SETTINGS))

    def lacking(self, needs: Needs) -> list[str]:
        return self.capabilities.lacking(needs)

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        settings = effects.settings
        ranks = buckets.ranks(gaussians, camera) if settings.bucketed else None
        if settings.packing is not None:
            gaussians = packed(gaussians, camera, settings.packing)
        with torch.no_grad():
            rows = drawn_rows(gaussians, camera, effects, ranks)
        gaussians = gaussians[rows]
        projected, feet = _footprints(gaussians, camera, effects)
        degree = min(effects.sh_degree, gaussians.sh_degree)
        rgb = colors(gaussians.sh, gaussians.means, camera.center.to(gaussians.means), degree)
        if settings.max_color is not None:
            rgb = rgb.clamp_max(settings.max_color)
        if settings.color_steps is not None:
            rgb = in_steps(rgb, rgb.new_tensor(settings.color_steps))
        least = least_alpha(feet, settings)
        one_by_one = alone(feet.alpha, settings.max_alpha, settings.culls)
        alphas, room = (feet.alphas, feet.ROOM) if isinstance(feet, WindowIntegral) else (one_by_one, 1)
        splats = Splats(projected.means2d, feet.packed(), rgb, least, alphas, room)
        image, through = composite(splats, feet.extents(least), camera, settings, rgb.new_tensor(effects.background))
        return Rendered(image, 1 - through)


def drawn_rows(gaussians: Gaussians, camera: Camera, effects: Effects, ranks: Tensor | None = None) -> Tensor:
    """Indices of the splats that can touch the image, front to back: as `ranks` [N] ascend, where they are given.

    Found first and without gradients, so that a row that is not drawn, however broken, is in no gradient either.
    """
    projected, feet = _footprints(gaussians, camera, effects)
    least = least_alpha(feet, effects.settings)
    half = feet.extents(least)
    low, high = projected.means2d - half, projected.means2d + half
    inside = (high > 0).all(1) & (low < low.new_tensor([camera.width, camera.height])).all(1)
    if effects.settings.frame < math.inf:
        inside &= (2 * projected.means2d / low.new_tensor([camera.width, camera.height]) - 1).abs().amax(1) <= effects.settings.frame
    drawn = finite_rows(gaussians) & (projected.depths > effects.near_plane) & feet.visible(least) & inside
    rows = drawn.nonzero()[:, 0]
    along = (gaussians.means - camera.center.to(gaussians.means)).norm(dim=1) if effects.settings.radial else projected.depths
    along = along if ranks is None else ranks
    return rows[along[rows].argsort(stable=True)]


def finite_rows(gaussians: Gaussians) -> Tensor:
    """[N] bool: rows whose every number is finite."""
    given = [gaussians.means, gaussians.opacities[:, None], gaussians.sh.flatten(1)]
    shape = [gaussians.quats, gaussians.scales] if gaussians.covariances is None else [gaussians.covariances.flatten(1)]
    return torch.isfinite(torch.cat(given + shape, dim=1)).all(1)


@torch.no_grad()
def least_alpha(feet: Footprint | PixelIntegral | Surfels, settings: RenderSettings) -> Tensor:
    """[N]: the alpha below which each splat is not drawn. A radius of r standard deviations is exp(-r²/2) of its brightest.

    One that fades is nothing there.
    """
    numbers = feet.packed()
    if settings.radius is None or settings.fades:
        return numbers.new_full(numbers.shape[:1], settings.min_alpha)
    zero = torch.zeros_like(numbers[:, 0])
    return (feet.alpha(numbers, zero, zero) * math.exp(-(settings.radius**2) / 2)).clamp_min(settings.min_alpha)


def _footprints(gaussians: Gaussians, camera: Camera, effects: Effects) -> tuple[Projected, Footprint | PixelIntegral | Surfels]:
    if effects.screen_filter == SURFEL:
        return surfels(gaussians, camera, effects)
    projected = project(gaussians, camera, effects.near_plane, effects.settings.frozen_beyond)
    most = effects.settings.max_variance(camera.width, camera.height)
    return projected, footprint(projected, gaussians.opacities, effects.screen_filter, effects.eps2d, effects.settings, most)
