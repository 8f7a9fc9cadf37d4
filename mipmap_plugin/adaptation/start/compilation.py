"""Compilation: what a run will call is called on two splats first, so that compiling it counts in no later phase."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from mipmap_plugin.adaptation.start.blend_weights import blend_weights
from mipmap_plugin.adaptation.start.merging import merge
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians

CAMERA = Camera(1, 1, 1.0, 1.0, 0.5, 0.5, torch.eye(4))


def warm_up(backend: Backend, gaussians: Gaussians, effects: Sequence[Effects], *, gradients: bool, merging: bool) -> None:
    """Let the backend compile what draws splats like these with all `effects`, and what their `gradients` and `merging` need."""
    few = gaussians[torch.arange(min(2, len(gaussians)))].detach()
    for number, setting in enumerate(effects):
        drawn = replace(few, means=few.means.clone().requires_grad_(gradients))
        image = backend.render(drawn, CAMERA, setting).image
        if merging and number == 0:  # here, because another process may be compiling the backward pass by now
            weights = blend_weights(few, [CAMERA], backend, setting)
            merge(few, torch.ones_like(weights), weights, fraction=0.5)
        if gradients and image.requires_grad:
            image.sum().backward()
