"""Zoom-in beyond what the base knows: its image, enlarged by an upsampler, as a second target, believed where there is reason to.

Three things keep a zoom-in from an upsampler's faults. By frequency: up to what the base itself samples, the target is the base, by
back-projection (Irani and Peleg 1991), so that only finer detail is the upsampler's. By pixel: where the enlarged image, shrunk, was
not the base's, little of it counts. Between views: differences count by their size and not by their square, so that what one view
claims and others deny is outvoted. Part of the difference is one of structure (SSIM) and of how strong contrasts are: views that
disagree by less than a pixel blur what is learnt from differences alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from tqdm import tqdm

from mipmap_plugin.adaptation.target.pseudo_truth import parked
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.structure import similarity
from mipmap_plugin.adaptation.target.upsamplers import find_upsampler
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig

# Rounds of back-projection: the first gains a GAN's image 1.4 dB (lego at x2), two more another 0.2.
ROUNDS = 3

# Of 0..1: where the shrunk image is this far from the base's, a quarter of it is believed, and of what is far worse next to nothing.
TRUST = 0.05

# Noise has the strongest contrasts of all, and agrees with the base by chance here and there: contrasts have to be believed more
# firmly, by this power beside the one that all counts by. With 2, a network that makes nothing but noise still costs 0.2 dB against
# the closed form; with 3 nothing.
SURE = 3


class Detail:
    """The part of the loss that draws an image of the new scale towards the upsampled base; each view is enlarged once."""

    def __init__(self, truth: Callable[[Camera], Tensor], scale: float, config: AdaptConfig) -> None:
        """`truth`: the base's own image of a view. Raises what `find_upsampler` does."""
        self._truth, self._scale, self._config = truth, scale, config
        self._enlarge = find_upsampler(config.upsampler)
        self._made: dict[Camera, tuple[Tensor, Tensor]] = {}

    def prepare(self, views: Sequence[Camera]) -> None:
        """Enlarge the views beforehand, which may take seconds for each."""
        for view in tqdm(views, disable=None, desc=f"upsampling x{self._scale:g}", unit="view"):
            self._of(view)

    def __call__(self, view: Camera, image: Tensor) -> Tensor:
        """The loss of `image` [H, W, 3], what the view of the base scale shows at the new one."""
        target, confidence = (tensor.to(image) for tensor in self._of(view))
        confidence = resize(confidence, view.zoomed(self._scale).size, "bilinear")
        return self._config.detail_weight * (confidence * self._difference(image, target, confidence)).mean()

    def _difference(self, image: Tensor, target: Tensor, confidence: Tensor) -> Tensor:
        """[H, W, 3]"""
        structure, contrast = self._config.detail_structure, self._config.detail_contrast
        difference = (1 - structure) * (image - target).abs()
        if structure == contrast == 0:
            return difference
        ssim, as_strong = similarity(image, target)
        return difference + structure * (1 - ssim) + contrast * confidence**SURE * (1 - as_strong)

    def _of(self, view: Camera) -> tuple[Tensor, Tensor]:
        if view not in self._made:
            target, confidence = self._make(view)
            self._made[view] = parked(target.half()), parked(confidence)  # a hundred views of a photograph's size are gigabytes
        return self._made[view]

    @torch.no_grad()
    def _make(self, view: Camera) -> tuple[Tensor, Tensor]:
        """The fused target [H, W, 3] and how far it is believed, [h, w, 1] in 0..1."""
        base, size = self._truth(view), view.zoomed(self._scale).size
        enlarged = self._enlarge(base, size)
        lacking = self._lacking(enlarged, base)
        confidence = 1 / (1 + lacking.square().mean(-1, keepdim=True) / TRUST**2) ** 2
        for _ in range(ROUNDS):
            enlarged = enlarged + resize(self._lacking(enlarged, base), size, "pil-bicubic")
        return enlarged.clamp(0, 1), confidence

    def _lacking(self, enlarged: Tensor, base: Tensor) -> Tensor:
        """What the enlarged image, shrunk, is short of the base's image [h, w, 3]."""
        return base - resize(enlarged, (base.shape[0], base.shape[1]), self._config.resize)
