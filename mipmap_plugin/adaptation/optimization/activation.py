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

    Shared, each view has leaves of its own, so that views can be drawn side by side; their gradients are gathered in the order of the
    views, whatever order they were drawn in. Activations, about a tenth of the time of small images, are computed and differentiated once.
    """

    def __init__(self, model: SplatModel, *, share: bool) -> None:
        self._model, self.shares = model, share and model.traits.same_for_all_views
        self._splats: Gaussians | None = None
        self._gradients: dict[str, Tensor] = {}
        self._before: Tensor | None = None  # the gradient of the means from the views so far, where nothing is shared

    def activate(self, camera: Camera) -> None:
        """Make the splats that are shared, before any view asks for them."""
        self._splats = self._model.gaussians(camera) if self.shares else None

    def __call__(self, camera: Camera) -> Gaussians:
        """What the camera sees."""
        if self._splats is None:
            return self._model.gaussians(camera)
        held = _tensors(self._splats)
        return replace(self._splats, **{name: tensor.detach().requires_grad_(tensor.requires_grad) for name, tensor in held.items()})

    def gather(self, seen: Gaussians) -> None:
        """Take the gradients of the splats that one view has `seen`."""
        if self._splats is None:
            return
        for name, leaf in _tensors(seen).items():
            if leaf.grad is not None:
                self._gradients[name] = self._gradients[name].add_(leaf.grad) if name in self._gradients else leaf.grad

    def of_means(self, seen: Gaussians) -> tuple[Tensor, Tensor]:
        """The means [N, 3] and their gradient from the one view that has `seen` these splats, the latest."""
        if self._splats is not None:
            return seen.means, torch.zeros_like(seen.means) if seen.means.grad is None else seen.means.grad
        means = self._model.parameters()["means"]
        gradient = torch.zeros_like(means) if means.grad is None else means.grad if self._before is None else means.grad - self._before
        self._before = gradient.clone() if self._before is None else self._before + gradient
        return means, gradient

    def backward(self) -> None:
        """Hand the gathered gradients on, once all views have left theirs."""
        if self._splats is None:
            return
        splats = _tensors(self._splats)
        # Their product with what they are multiplied by has these very gradients. torch.autograd.backward, which takes gradients, loads sympy.
        products = [(splats[name] * gradient).sum() for name, gradient in self._gradients.items()]
        self._splats, self._gradients = None, {}  # the optimizer and density control need the room
        if products:
            torch.stack(products).sum().backward()


def _tensors(gaussians: Gaussians) -> dict[str, Tensor]:
    held = {field.name: getattr(gaussians, field.name) for field in fields(gaussians)}
    return {name: tensor for name, tensor in held.items() if tensor is not None}
