"""The reference backend: readable, pure torch, on any device, in float32 or float64, with exact gradients.

Splats are placed and shaped in float64 and blended in their own dtype: what is computed per splat takes little of the time, and where numbers are
large and cancel; what is computed per pixel takes most of it, of numbers that are near 1.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.backends.base import API_VERSION, SETTINGS, Capabilities, Needs, Rendered
from mipmap_plugin.backends.linear_light import in_linear_light
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import SURFEL, Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import RenderSettings
from mipmap_plugin.screen_filters import SCREEN_FILTERS
from mipmap_plugin.splatting.buckets import ranks_of_views
from mipmap_plugin.splatting.compositing import SortedSplats, composite, independent
from mipmap_plugin.splatting.filters import Footprint, footprint
from mipmap_plugin.splatting.harmonics import colors
from mipmap_plugin.splatting.packing import packed, round_to
from mipmap_plugin.splatting.pixel_integral import PixelIntegral
from mipmap_plugin.splatting.precision import exact
from mipmap_plugin.splatting.projection import project
from mipmap_plugin.splatting.surfels import Surfels, surfels
from mipmap_plugin.splatting.window import WindowIntegral

Footprints = Footprint | PixelIntegral | Surfels


class ReferenceBackend:
    """The backend that all others are compared with."""

    name = "reference"
    api_version = API_VERSION
    speed = 0
    capabilities = Capabilities(None, frozenset({torch.float32, torch.float64}), frozenset({*SCREEN_FILTERS, SURFEL}), settings=frozenset(SETTINGS))

    def lacking(self, needs: Needs) -> list[str]:
        """The reasons why this backend cannot serve `needs`; empty if it can."""
        return self.capabilities.lacking(needs)

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        """The view of `camera`. Only the splats that can touch the image take part in the gradient graph."""
        settings = effects.settings
        if settings.linear_light is not None:
            return in_linear_light(self.render, gaussians, camera, effects)
        [ranks] = ranks_of_views(gaussians, [(camera, effects)])
        gaussians = packed(gaussians, camera, settings.packing)
        with torch.no_grad():
            rows = drawn_rows(gaussians, camera, effects, ranks)
        gaussians = gaussians[rows]
        wide = exact(gaussians)
        means2d, _, footprints = _footprints(wide, camera, effects, gaussians.means.dtype)
        degree = min(effects.sh_degree, gaussians.sh_degree)
        rgb = colors(gaussians.sh, wide.means, camera.center.to(wide.means), degree)
        if settings.max_color is not None:
            rgb = rgb.clamp_max(settings.max_color)
        if settings.color_steps is not None:
            rgb = round_to(rgb, rgb.new_tensor(settings.color_steps))
        least = least_alpha(footprints, settings)
        by_splat = independent(footprints.alpha, settings.max_alpha, settings.culls)
        alphas, memory = (footprints.alphas, footprints.MEMORY_FACTOR) if isinstance(footprints, WindowIntegral) else (by_splat, 1)
        splats = SortedSplats(means2d.to(rgb), footprints.packed(), rgb, least, alphas, memory)
        image, transmittance = composite(splats, footprints.extents(least), camera, settings, rgb.new_tensor(effects.background))
        return Rendered(image, 1 - transmittance)


def drawn_rows(gaussians: Gaussians, camera: Camera, effects: Effects, ranks: Tensor | None) -> Tensor:
    """Indices of the splats that can touch the image, front to back; in ascending order of `ranks` [N], or of their depths.

    Computed first and without gradients, so that splats that are not drawn, even NaN, are not part of any gradient.
    """
    wide = exact(gaussians)
    means2d, depths, footprints = _footprints(wide, camera, effects, gaussians.means.dtype)
    least = least_alpha(footprints, effects.settings)
    half = footprints.extents(least)
    low, high = means2d - half, means2d + half
    size = low.new_tensor([camera.width, camera.height])
    inside = (high > 0).all(1) & (low < size).all(1)
    if effects.settings.frame < math.inf:
        inside &= (2 * means2d / size - 1).abs().amax(1) <= effects.settings.frame
    drawn = finite_rows(gaussians) & (depths > effects.near_plane) & footprints.visible(least) & inside
    rows = drawn.nonzero()[:, 0]
    keys = (wide.means - camera.center.to(wide.means)).norm(dim=1) if effects.settings.radial else depths
    keys = keys if ranks is None else ranks
    return rows[keys[rows].argsort(stable=True)]


def finite_rows(gaussians: Gaussians) -> Tensor:
    """Which splats have finite numbers only, [N] bool."""
    always = [gaussians.means, gaussians.opacities[:, None], gaussians.sh.flatten(1)]
    shape = [gaussians.quats, gaussians.scales] if gaussians.covariances is None else [gaussians.covariances.flatten(1)]
    return torch.isfinite(torch.cat(always + shape, dim=1)).all(1)


@torch.no_grad()
def least_alpha(footprints: Footprints, settings: RenderSettings) -> Tensor:
    """The alpha below which each splat is not drawn, [N]: `min_alpha`, or exp(-r²/2) times its peak if it is cut at a radius of r.

    A splat that fades is not cut: its alpha is 0 at that radius.
    """
    parameters = footprints.packed()
    if settings.radius is None or settings.fades:
        return parameters.new_full(parameters.shape[:1], settings.min_alpha)
    zero = torch.zeros_like(parameters[:, 0])
    return (footprints.alpha(parameters, zero, zero) * math.exp(-(settings.radius**2) / 2)).clamp_min(settings.min_alpha)


def _footprints(gaussians: Gaussians, camera: Camera, effects: Effects, dtype: torch.dtype) -> tuple[Tensor, Tensor, Footprints]:
    """Means on the image, [N, 2] px, and depths, [N], in the dtype of `gaussians`; and the footprints in `dtype`."""
    footprints: Footprints
    if effects.screen_filter == SURFEL:
        means2d, depths, footprints = surfels(gaussians, camera, effects)
    else:
        projected = project(gaussians, camera, effects.near_plane, effects.settings)
        means2d, depths, most = projected.means2d, projected.depths, effects.settings.max_variance(camera.width, camera.height)
        footprints = footprint(projected, gaussians.opacities, effects.screen_filter, effects.eps2d, effects.settings, most)
    rounded: dict[str, Any] = {name: value.to(dtype) for name, value in vars(footprints).items() if isinstance(value, Tensor)}
    return means2d, depths, replace(footprints, **rounded)
