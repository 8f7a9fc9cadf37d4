"""Pseudo ground truth: the image that each camera should see at the new scale, made once per view from the frozen base model."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, partial

import torch
from torch import Tensor

from mipmap_plugin.adaptation.target.base_images import BaseImages
from mipmap_plugin.adaptation.target.image_store import ImageStore
from mipmap_plugin.adaptation.target.photographs import Photographs
from mipmap_plugin.adaptation.target.resize import resize, resize_all
from mipmap_plugin.adaptation.target.upsamplers import Upsampler, check_upsampler, find_upsampler
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import enlarges
from mipmap_plugin.errors import SettingsError

# Bytes of the images that a run keeps: 1100 of 800 x 800 px, or 350 photographs of 1600 x 1200 px. Those beyond are resized from the base's
# own again in every step, which takes half as long again.
LIMIT = 4 << 30


class PseudoTruth:
    """The base model's image of a camera, resized to the new scale: [H, W, 3] float, kept by camera.

    Unless `compare_at` is "target", the truth of a zoom-in keeps the base's size: the adapted image, shrunk, is compared with it. A
    photograph then replaces the base's image, for the views that have one.
    """

    def __init__(self, base: BaseImages, scale: float, config: AdaptConfig, photographs: Photographs | None = None) -> None:
        """Raises SettingsError for an unknown upsampler."""
        self._base, self._scale, self._config = base, scale, config
        check_upsampler(config.upsampler)
        if photographs and (scale <= 1 or config.compare_at == "target" or not config.steps):
            only = "real images can be used only for a zoom-in that takes steps and is compared with the base at its own scale"
            raise SettingsError(f"{only}; leave them (--images) out")
        self._photographs = photographs
        self._store = ImageStore(LIMIT, base.model.parameters()["means"])

    def __call__(self, view: Camera) -> Tensor:
        """Return the pseudo truth of a camera of the base scale."""
        return self._store(view, lambda: self._make(view))

    def prepare(self, views: Sequence[Camera]) -> None:
        """Make the truths of `views` that are not known: those of one size together, as a GPU waits for each operation."""
        new = {view: None for view in views if view not in self._store}
        if self._photographs or enlarges(self._config, self._scale) or not self._base.draws_together:
            for view in new:
                self(view)
            return
        sizes: dict[tuple[int, int, float], list[Camera]] = {}
        for view in new:
            sizes.setdefault((view.width, view.height, view.zoom / view.base_zoom), []).append(view)
        for same in sizes.values():
            self._store.of_one_size(same, partial(self._make_together, same))

    @cached_property
    def _enlarge(self) -> Upsampler:
        """The upsampler, loaded when it is first needed."""
        return find_upsampler(self._config.upsampler)

    @torch.no_grad()
    def _make(self, view: Camera) -> Tensor:
        size = view.zoomed(self._scale).size
        if enlarges(self._config, self._scale):
            target = self._enlarge(self._base(view), size)
        elif self._scale > 1:
            photograph = self._photographs(view) if self._photographs else None
            target = self._base(view) if photograph is None else photograph
        else:
            target = resize(self._base(view, resolution(self._config, self._scale, view.zoom / view.base_zoom)), size, self._config.resize)
        return quantized(target, self._config)

    @torch.no_grad()
    def _make_together(self, same: Sequence[Camera], numbers: Sequence[int]) -> Tensor:
        """The truths [V, h, w, 3] of some of the views of one size, by their numbers."""
        views = [same[number] for number in numbers]
        images = self._base.of_one_size(views, 1.0 if self._scale > 1 else resolution(self._config, self._scale, views[0].zoom / views[0].base_zoom))
        truths = images if self._scale > 1 else resize_all(images, views[0].zoomed(self._scale).size, self._config.resize)
        return quantized(truths, self._config)


def resolution(config: AdaptConfig, scale: float, zoom: float = 1.0) -> float:
    """The fraction of the base scale at which the base is rendered: more than `truth_oversampling` samples a pixel gain nothing.

    `zoom`: of the view relative to the base scale, in a band.
    """
    return 1.0 if config.truth_oversampling is None else min(1.0, config.truth_oversampling * scale * zoom)


def quantized(target: Tensor, config: AdaptConfig) -> Tensor:
    """A truth [..., h, w, 3] as the settings have it: rounded to 8 bits, or as it is."""
    return target.clamp(0, 1).mul(255).round().div(255) if config.quantize_truth else target
