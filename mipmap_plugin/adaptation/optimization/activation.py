"""The splats of one step: activated once for all of its views where every camera sees the same ones."""

from __future__ import annotations

from dataclasses import fields, replace

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel


class Activation:
    """A model's splats for the views of a step, and the way of their gradients back to its parameters.

    Shared, the views' gradients are gathered at the splats: the graph of a view is gone before the next is drawn, and activations,
    about a tenth of the time of small images, are computed and differentiated once.
    """

    def __init__(self, model: SplatModel, *, share: bool) -> None:
        self._model, self._shares = model, share and model.traits.same_for_all_views
        self._splats: Gaussians | None = None
        self._leaves: Gaussians | None = None

    def __call__(self, camera: Camera) -> Gaussians:
        """What the camera sees."""
        if not self._shares:
            return self._model.gaussians(camera)
        if self._leaves is None:
            self._splats = self._model.gaussians(camera)
            held = _tensors(self._splats)
            self._leaves = replace(self._splats, **{name: tensor.detach().requires_grad_(tensor.requires_grad) for name, tensor in held.items()})
        return self._leaves

    @property
    def means(self) -> Tensor:
        """Where the gradients of the means [N, 3] gather, view by view."""
        return self._model.parameters()["means"] if self._leaves is None else self._leaves.means

    def backward(self) -> None:
        """Hand the gathered gradients on, once all views have left theirs."""
        if self._splats is None or self._leaves is None:
            return
        leaves, splats = _tensors(self._leaves), _tensors(self._splats)
        self._leaves = self._splats = None  # the optimizer and density control need the room
        # Their product with what they are multiplied by has these very gradients. torch.autograd.backward, which takes gradients, loads sympy.
        products = [(splats[name] * leaf.grad).sum() for name, leaf in leaves.items() if leaf.grad is not None]
        if products:
            torch.stack(products).sum().backward()


def _tensors(gaussians: Gaussians) -> dict[str, Tensor]:
    held = {field.name: getattr(gaussians, field.name) for field in fields(gaussians)}
    return {name: tensor for name, tensor in held.items() if tensor is not None}
