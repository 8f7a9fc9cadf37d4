"""Pseudo ground truth: the image that each camera should see at the new scale, made once per view from the frozen base model."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from mipmap_plugin.adaptation.target.photographs import Photographs
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.upsamplers import Upsampler, check_upsampler, find_upsampler
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects, enlarges
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel

# The fraction of a GPU's memory that images of the truth leave free.
LEFT_FREE = 0.5


class PseudoTruth:
    """The base model's image of a camera, resized to the new scale: [H, W, 3] float, cached by camera.

    Unless `compare_at` is "target", the truth of a zoom-in keeps the base's size: the adapted image, shrunk, is compared with it. A
    photograph then replaces the base's image, for the views that have one.
    """

    def __init__(
        self,
        base: SplatModel,
        backend: Backend,
        effects: Effects,
        scale: float,
        config: AdaptConfig,
        photographs: Photographs | None = None,
    ) -> None:
        """`effects`: how the base is rendered at the scale of its training. Raises SettingsError for an unknown upsampler."""
        self._base, self._backend, self._effects, self._scale, self._config = base, backend, effects, scale, config
        check_upsampler(config.upsampler)
        if photographs and (scale <= 1 or config.compare_at == "target"):
            raise SettingsError("real images can be used only for a zoom-in that is compared with the base at its own scale; leave them out")
        self._photographs = photographs
        self._images: dict[Camera, Tensor] = {}
        self._activated: Gaussians | None = None

    def __call__(self, view: Camera) -> Tensor:
        """Return the pseudo truth of a camera of the base scale."""
        if view not in self._images:
            self._images[view] = moved_off_full_gpu(self._make(view))
        return self._images[view].to(self._base.parameters()["means"].device, non_blocking=True)

    @cached_property
    def _enlarge(self) -> Upsampler:
        """The upsampler, loaded when it is first needed."""
        return find_upsampler(self._config.upsampler)

    @torch.no_grad()
    def _make(self, view: Camera) -> Tensor:
        size = view.zoomed(self._scale).size
        if enlarges(self._config, self._scale):
            target = self._enlarge(self._render(view, 1.0), size)
        elif self._scale > 1:
            photograph = self._photographs(view) if self._photographs else None
            target = self._render(view, 1.0) if photograph is None else photograph
        else:
            target = resize(self._render(view, self._resolution(view)), size, self._config.resize)
        return target.clamp(0, 1).mul(255).round().div(255) if self._config.quantize_truth else target

    def _resolution(self, view: Camera) -> float:
        """The fraction of the base scale at which the base is rendered: more than `truth_oversampling` samples a pixel gain nothing."""
        oversampling = self._config.truth_oversampling
        return 1.0 if oversampling is None else min(1.0, oversampling * self._scale * view.zoom)

    def _render(self, view: Camera, fraction: float) -> Tensor:
        """Render the base at a fraction of its own scale; its dilation keeps its size in the world.

        The image is clamped before any resizing, as a display does: unclamped highlights would bleed into their neighbors (-3 dB at x1/8).
        """
        # Resized, not zoomed: the model sees the `zoom` of its training, so that it shows the same splats, only with fewer pixels.
        factor = fraction / view.zoom  # a view of a band (`over_band`) samples `zoom` times as finely as the base
        camera = view if factor == 1 else replace(view.resized(max(1, round(view.width * factor)), max(1, round(view.height * factor))), zoom=1.0)
        effects = replace(self._effects, eps2d=self._effects.eps2d * fraction**2)
        return self._backend.render(self._splats(camera), camera, effects).image.clamp(0, 1)

    def _splats(self, camera: Camera) -> Gaussians:
        """The base's splats, activated once if all cameras see the same ones: activation takes a fifth of a small image's time."""
        if not self._base.traits.same_for_all_views:
            return self._base.gaussians(camera)  # not kept: views may be rendered in parallel
        if self._activated is None:
            self._activated = self._base.gaussians(camera)
        return self._activated


def moved_off_full_gpu(target: Tensor) -> Tensor:
    """Return `target`, or, if half of its GPU's memory is used, a copy in pinned host memory, which the GPU reads without blocking the host."""
    if target.device.type != "cuda":
        return target
    free, total = torch.cuda.mem_get_info(target.device)
    return target if free > LEFT_FREE * total else target.cpu().pin_memory()
