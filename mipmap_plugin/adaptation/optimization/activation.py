"""The activated splats of one step: computed once for all of its views, where all cameras see the same splats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel


class Activation:
    """A model's activated splats for the views of a step; passes their gradients back to the model's parameters.

    When shared, the views that are drawn in one call get leaves of their own, so that no graph outlives its call; gradients are summed in the order
    of the calls. Activations, about a tenth of the time of small images, are computed and differentiated once.
    """

    def __init__(self, model: SplatModel, *, share: bool) -> None:
        self._model, self.shares = model, share and model.traits.same_for_all_views
        self._splats: Gaussians | None = None
        self._gradients: dict[str, Tensor] = {}
        self._before: Tensor | None = None  # the gradient of the means from the views so far, if not shared

    def activate(self, camera: Camera) -> None:
        """Activate the shared splats, before the first view."""
        self._splats = self._model.gaussians(camera) if self.shares else None

    def __call__(self, camera: Camera) -> Gaussians:
        """Return the splats that the camera sees."""
        if self._splats is None:
            return self._model.gaussians(camera)
        leaves = {name: tensor.detach().requires_grad_(tensor.requires_grad) for name, tensor in self._splats.tensors().items()}
        return replace(self._splats, **leaves)

    def accumulate(self, splats: Gaussians) -> None:
        """Take the gradients of the `splats` that one view was rendered from, and add them up."""
        if self._splats is None:
            return
        for name, leaf in splats.tensors().items():
            if leaf.grad is not None:
                self._gradients[name] = self._gradients[name].add_(leaf.grad) if name in self._gradients else leaf.grad
                leaf.grad = None  # makes room for the next view's

    def means_gradient(self, splats: Gaussians) -> tuple[Tensor, Tensor]:
        """Return the means [N, 3] and their gradient in the latest view, which was rendered from `splats` and not accumulated yet."""
        if self._splats is not None:
            return splats.means, torch.zeros_like(splats.means) if splats.means.grad is None else splats.means.grad
        means = self._model.parameters()["means"]
        gradient = torch.zeros_like(means) if means.grad is None else means.grad if self._before is None else means.grad - self._before
        self._before = gradient.clone() if self._before is None else self._before + gradient
        return means, gradient

    def backward(self) -> None:
        """Pass the accumulated gradients on to the parameters, after the backward pass of the last view."""
        if self._splats is None:
            return
        splats = self._splats.tensors()
        gradients, self._splats, self._gradients = self._gradients, None, {}
        if gradients:
            end = WithGradients.apply(list(gradients.values()), *(splats[name] for name in gradients))  # type: ignore[no-untyped-call]  # torch's
            splats.clear()  # frees the memory of the joined colors for their gradients
            gradients.clear()
            end.backward()


class WithGradients(torch.autograd.Function):
    """A number whose backward pass hands `gradients` on to `tensors`. torch.autograd.backward takes them too, but it loads sympy."""

    @staticmethod
    def forward(ctx: Any, gradients: Sequence[Tensor], *tensors: Tensor) -> Tensor:
        ctx.gradients = gradients
        return tensors[0].new_zeros(())

    @staticmethod
    def backward(ctx: Any, _: Tensor) -> tuple[Tensor | None, ...]:
        gradients, ctx.gradients = ctx.gradients, None  # the colors' can be freed as soon as they are split
        return None, *gradients
