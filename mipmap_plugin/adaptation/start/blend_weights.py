"""How much of a scene's images each splat makes up: the sum of its blending weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.harmonics import C0


def light(gaussians: Gaussians, views: Sequence[Camera], backend: Backend, effects: Effects) -> Tensor:
    """[N] how many pixels of a view each splat fills, on average over `views`; 0 for one that is nowhere seen.

    An image is linear in the splats' colors, and so its weights are what a gray splat's color has for a gradient. From any backend
    with gradients.
    """
    color = torch.zeros_like(gaussians.sh[:, :1]).requires_grad_()
    plain = replace(effects, sh_degree=0, settings=effects.settings.of_any_color())
    with torch.enable_grad():
        for view in views:
            backend.render(replace(gaussians, sh=color), view, plain).image.sum().backward()
    assert color.grad is not None
    return color.grad[:, 0].mean(dim=1) / (C0 * len(views))
