"""The frozen teacher: what each camera should see at the new scale, made once per view from the base model and kept."""

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

# The share of a GPU's memory that images of the truth leave to the rest.
LEFT_FREE = 0.5


class PseudoTruth:
    """The base model's view of a camera, resized to the wanted scale, [H, W, 3] float, cached by camera.

    Unless `compare_at` is "target" a zoom-in's truth keeps the base's size: what is known is what the wanted image must shrink to.
    There a photograph takes the place of the base's image, for the views that have one.
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
        """`effects`: how the base is rendered at the scale that it was trained at. Raises SettingsError for an unknown upsampler."""
        self._base, self._backend, self._effects, self._scale, self._config = base, backend, effects, scale, config
        check_upsampler(config.upsampler)
        if photographs and (scale <= 1 or config.compare_at == "target"):
            raise SettingsError("real images take part only in a zoom-in that is compared with the base at its own scale; leave them out")
        self._photographs = photographs
        self._made: dict[Camera, Tensor] = {}
        self._activated: Gaussians | None = None

    def __call__(self, view: Camera) -> Tensor:
        """The pseudo truth of a camera of the base scale."""
        if view not in self._made:
            self._made[view] = parked(self._make(view))
        return self._made[view].to(self._base.parameters()["means"].device, non_blocking=True)

    @cached_property
    def _enlarge(self) -> Upsampler:
        """Loaded when the first image has to become larger."""
        return find_upsampler(self._config.upsampler)

    @torch.no_grad()
    def _make(self, view: Camera) -> Tensor:
        size = view.zoomed(self._scale).size
        if enlarges(self._config, self._scale):
            target = self._enlarge(self._render(view, 1.0), size)
        elif self._scale > 1:
            real = self._photographs(view) if self._photographs else None
            target = self._render(view, 1.0) if real is None else real
        else:
            target = resize(self._render(view, self._finest()), size, self._config.resize)
        return target.clamp(0, 1).mul(255).round().div(255) if self._config.quantize_truth else target

    def _finest(self) -> float:
        """The share of the base scale that is rendered: a filter that reads many samples a pixel gains nothing from more."""
        oversampling = self._config.truth_oversampling
        return 1.0 if oversampling is None else min(1.0, oversampling * self._scale)

    def _render(self, view: Camera, share: float) -> Tensor:
        """The base at `share` of its own scale; its dilation keeps the size that it had in the world.

        Clamped before any resizing, as a display does: unclamped highlights would bleed into their neighbors (-3 dB at x1/8).
        """
        # Resized, not zoomed: the base is asked for what it showed in training, at fewer pixels.
        camera = view if share == 1 else view.resized(max(1, round(view.width * share)), max(1, round(view.height * share)))
        effects = replace(self._effects, eps2d=self._effects.eps2d * share**2)
        return self._backend.render(self._splats(camera), camera, effects).image.clamp(0, 1)

    def _splats(self, camera: Camera) -> Gaussians:
        """The base's splats, activated once where they look the same to every camera: a fifth of a small image's time."""
        if self._activated is None or not self._base.traits.same_for_all_views:
            self._activated = self._base.gaussians(camera)
        return self._activated


def parked(target: Tensor) -> Tensor:
    """`target`, or, where half of its GPU's memory is taken, a copy in the host's that the GPU can fetch without waiting for the host."""
    if target.device.type != "cuda":
        return target
    free, total = torch.cuda.mem_get_info(target.device)
    return target if free > LEFT_FREE * total else target.cpu().pin_memory()
