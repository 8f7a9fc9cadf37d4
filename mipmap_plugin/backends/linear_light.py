"""Blending in linear light, around any backend: its colors are made linear, drawn as SH of degree 0, and the image is brought back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.backends.base import Rendered
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.harmonics import C0, colors
from mipmap_plugin.splatting.precision import exact

# sRGB (IEC 61966-2-1): up to here it is a line, and from here on a power of a scaled and shifted value.
LINE_ENDS, SLOPE, SHIFT, POWER = 0.0031308, 12.92, 0.055, 2.4


def in_linear_light(render: Callable[[Gaussians, Camera, Effects], Rendered], gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
    """The view of `camera` by `render`, blended in linear light: `effects.settings.linear_light` is the power that colors are raised to."""
    power = effects.settings.linear_light
    assert power is not None
    # Before the colors, whose derivative in a row with NaN is NaN. Such rows are not drawn.
    finite = gaussians.means.isfinite().all(1) & gaussians.sh.isfinite().flatten(1).all(1)
    gaussians = gaussians if finite.all() else gaussians[finite.nonzero()[:, 0]]
    means = exact(gaussians).means
    shown = colors(gaussians.sh, means, camera.center.to(means), min(effects.sh_degree, gaussians.sh_degree))
    splats = replace(gaussians, sh=((shown**power - 0.5) / C0)[:, None])
    plain = replace(effects.settings, linear_light=None)
    red, green, blue = map(_linear, effects.background)
    rendered = render(splats, camera, replace(effects, sh_degree=0, background=(red, green, blue), settings=plain))
    return rendered.replaced(image=encoded(rendered.image))


def encoded(light: Tensor) -> Tensor:
    """sRGB of linear light, of any shape and at least 0; both branches have finite gradients everywhere."""
    curve = (1 + SHIFT) * light.clamp_min(LINE_ENDS) ** (1 / POWER) - SHIFT
    return torch.where(light <= LINE_ENDS, SLOPE * light, curve)


def _linear(value: float) -> float:
    """Linear light of an sRGB value; below 0, as on the line."""
    return value / SLOPE if value <= LINE_ENDS * SLOPE else ((value + SHIFT) / (1 + SHIFT)) ** POWER
