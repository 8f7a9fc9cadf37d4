"""A splat whose closed form is known: a disc that faces the camera."""

from dataclasses import replace

import torch

from mipmap_plugin.adaptation.start.closed_form import FormSettings, closed_form
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.screen_filters import DILATION
from mipmap_plugin.splatting.filters import footprint
from mipmap_plugin.splatting.projection import project

DEPTH, FOCAL = 4.0, 40.0
PIXEL = DEPTH / FOCAL  # world units
VIEW = Camera(32, 24, FOCAL, FOCAL, 16.0, 12.0, torch.eye(4))


def disc(width: float, height: float, opacity: float = 0.7, count: int = 1) -> Gaussians:
    """Flat splats on the optical axis that face the camera; standard deviations in px of the base."""
    means = torch.tensor([[0.0, 0.0, DEPTH]], dtype=torch.float64).repeat(count, 1)
    scales = means.new_tensor([[width * PIXEL, height * PIXEL, 0.0]]).repeat(count, 1)
    quats = means.new_tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1)
    return Gaussians(means, quats, scales, means.new_full((count,), opacity), means.new_ones(count, 1, 3))


def show(gaussians: Gaussians, scale: float, eps2d: float = DILATION, screen_filter: str = "classic"):
    return ReferenceBackend().render(gaussians, VIEW.zoomed(scale), Effects(0, screen_filter, eps2d)).image


def adapted(gaussians: Gaussians, scale: float, base: Effects = Effects(0), target: Effects = Effects(0), crispness: float = 0.0) -> Gaussians:  # noqa: B008
    scales, opacities = closed_form(gaussians, [VIEW], scale, base, target, FormSettings(crispness=crispness))
    return replace(gaussians, scales=scales, opacities=opacities)


def seen_from(depth: float) -> Camera:
    """The view from another distance of the discs."""
    viewmat = VIEW.viewmat.clone()
    viewmat[2, 3] = depth - DEPTH
    return VIEW.looking_from(viewmat, f"from {depth:g}")


def light(splat: Gaussians, scale: float, effects: Effects, view: Camera = VIEW) -> float:
    """px², over 2π: what a splat adds to an image."""
    shown = footprint(project(splat, view.zoomed(scale), effects.near_plane), splat.opacities, effects.screen_filter, effects.eps2d)
    return float(shown.opacities * (shown.yy * shown.across).sqrt())
