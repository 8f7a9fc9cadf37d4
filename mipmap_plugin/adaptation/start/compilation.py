"""Compilation: what a run will call is called on two splats first, so that compiling it counts in no later phase."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from mipmap_plugin.adaptation.parallel import views_at_once
from mipmap_plugin.adaptation.renderers import unrounded
from mipmap_plugin.adaptation.start.blend_weights import blend_weights
from mipmap_plugin.adaptation.start.closed_form import closed_form
from mipmap_plugin.adaptation.start.merging import merge
from mipmap_plugin.backends.base import AdamStep, Calls
from mipmap_plugin.camera import ONE_PIXEL, Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import OF_3DGS
from mipmap_plugin.render_settings import USUAL


def warm_up(backend: Any, gaussians: Gaussians, effects: Sequence[Effects], calls: Calls) -> None:
    """Let the backend compile what draws splats like these with all `effects` in such calls; merging calls the closed form too."""
    few = gaussians[torch.arange(min(2, len(gaussians)))].detach()
    if hasattr(backend, "compile_ahead"):
        backend.compile_ahead(few, effects, calls)
    steps = calls.by_rows and hasattr(backend, "stepper") and all(each.settings.linear_light is None for each in effects)
    # The first with the usual settings, and the first with others, for which a backend may have kernels of their own.
    kinds = list({setting.settings == USUAL: setting for setting in reversed(effects)}.values())
    for setting in effects:
        image = backend.render(replace(few, means=few.means.clone().requires_grad_(calls.gradients)), ONE_PIXEL, setting).image
        if calls.merging and setting in kinds:  # here, because another process may be compiling the backward pass by now
            weights = blend_weights(few, [ONE_PIXEL], backend, setting)
            merge(few, torch.ones_like(weights), weights[:, None], fraction=0.5)
            closed_form(few, [ONE_PIXEL], 0.5, effects[0], setting)
        if calls.gradients and image.requires_grad and not steps:
            image.sum().backward()
    if steps and calls.gradients:
        for kind in kinds:
            _step(backend, few, kind)


def calls_of(views: Sequence[Camera], scale: float, config: AdaptConfig, *, gradients: bool, merging: bool, plain: bool) -> Calls:
    """What an adaptation over views of the base's scale calls; plain: whether the backend may move the model's rows itself (`Traits.plain`)."""
    zoomed = [view.zoomed(scale) for view in views]
    pixels = [view.width * view.height for view in (*views, *zoomed)]
    at_once = views_at_once(zoomed) if config.densify_gradient is None else 1  # splats grow by the gradients of each view
    return Calls(gradients, merging, plain and config.views_per_step <= at_once, (min(pixels), max(pixels) * config.views_per_step))


def _step(backend: Any, splats: Gaussians, effects: Effects) -> None:
    """A step that moves nothing."""
    raw = {name: getattr(splats, name).clone() for name in ("means", "quats", "scales", "opacities", "sh")}
    stepper = backend.stepper(raw)
    stepper.differentiate(0, torch.zeros_like(stepper.render(0, ONE_PIXEL, unrounded(effects)).image))
    moments = {name: torch.zeros_like(tensor) for name, tensor in raw.items()}
    rates = dict.fromkeys(OF_3DGS, 0.0)
    stepper.step(AdamStep(raw, moments, moments, rates, betas=(0.9, 0.999), correction=1.0, eps=1.0))
