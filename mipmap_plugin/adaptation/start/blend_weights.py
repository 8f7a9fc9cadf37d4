"""The blend weight of each splat: how much it contributes to the images of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.adaptation.parallel import max_threads
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.harmonics import C0
from mipmap_plugin.threads import side_by_side


def blend_weights(gaussians: Gaussians, views: Sequence[Camera], backend: Backend, effects: Effects) -> Tensor:
    """The blend weight of each splat, summed over the pixels of a view and averaged over `views`: [N] in pixels; 0 for an invisible splat.

    An image is linear in the splats' colors, so that the weights are the gradient of the image's sum with respect to the colors. Works
    with any backend that has gradients.
    """
    plain = replace(effects, sh_degree=0, settings=effects.settings.without_color_rounding())

    @torch.enable_grad()
    def color_gradient(view: Camera) -> Tensor:
        color = torch.zeros_like(gaussians.sh[:, :1]).requires_grad_()
        backend.render(replace(gaussians, sh=color), view, plain).image.sum().backward()
        assert color.grad is not None
        return color.grad

    total, *gradients = side_by_side(color_gradient, views, max_threads(gaussians.means, views[0]))
    for gradient in gradients:
        total += gradient
    return total[:, 0].mean(dim=1) / (C0 * len(views))
