"""How much of a scene's images each splat makes up: the sum of its blending weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.adaptation.small import most_threads
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.harmonics import C0
from mipmap_plugin.threads import side_by_side


def light(gaussians: Gaussians, views: Sequence[Camera], backend: Backend, effects: Effects) -> Tensor:
    """[N] how many pixels of a view each splat fills, on average over `views`; 0 for one that is nowhere seen.

    An image is linear in the splats' colors, and so its weights are what a gray splat's color has for a gradient. From any backend
    with gradients.
    """
    plain = replace(effects, sh_degree=0, settings=effects.settings.of_any_color())

    @torch.enable_grad()
    def of_view(view: Camera) -> Tensor:
        color = torch.zeros_like(gaussians.sh[:, :1]).requires_grad_()
        backend.render(replace(gaussians, sh=color), view, plain).image.sum().backward()
        assert color.grad is not None
        return color.grad

    first, *others = side_by_side(of_view, views, most_threads(gaussians.means, views[0]))
    for gradient in others:
        first += gradient
    return first[:, 0].mean(dim=1) / (C0 * len(views))
