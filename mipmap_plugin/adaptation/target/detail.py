"""Zoom-in with detail that the base does not have: the base's image, enlarged by an upsampler, as a second target, weighted by confidence.

Three measures keep an upsampler's faults out of the result. By frequency: up to what the base itself samples, the target is the base, by
back-projection (Irani and Peleg 1991), so that only finer detail is the upsampler's. By pixel: where the enlarged image, shrunk again,
differs from the base's, it has a low weight. Between views: the loss is absolute and not squared, so that detail of one view that the
others contradict is outvoted. Part of the loss compares structure (SSIM) and the strength of contrasts: differences alone would
learn blurred detail where views disagree by less than a pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from mipmap_plugin.adaptation.target.image_store import moved_off_full_gpu
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.structure import similarity
from mipmap_plugin.adaptation.target.upsamplers import find_upsampler
from mipmap_plugin.adaptation.views.schedule import halves_of, poses, spread
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.process.clock import now
from mipmap_plugin.progress import Bar
from mipmap_plugin.recipes import INTERPOLATIONS

# Iterations of back-projection: the first improves a GAN's image by 1.4 dB (lego at x2), two more by another 0.2.
ROUNDS = 3

# In colors of 0..1: where the shrunk image differs from the base's by this much, the confidence is a quarter; it falls fast beyond that.
TRUST = 0.05

# The contrast term has the confidence to this further power, the lowest at which a network that makes nothing but noise costs nothing: noise has
# the strongest contrasts of all, and agrees with the base by chance in places.
CONTRAST_POWER = 3


def unused_upsampler(config: AdaptConfig, scale: float) -> str | None:
    """That an upsampler was given which this adaptation does not use, and why; None if it is used, or if it is the one that nobody has to give."""
    if config.upsampler == AdaptConfig.model_fields["upsampler"].default or (scale > 1 and config.steps and config.compare_at != "base"):
        return None
    instead = "; recipe paper uses it" if config.upsampler in INTERPOLATIONS else ""
    taken = f"compare_at is {config.compare_at}{instead}" if config.steps else "no steps are taken"
    return f"the upsampler {config.upsampler} is not used, because {taken if scale > 1 else f'x{scale:g} is no zoom-in'}"


class DetailLoss:
    """The loss of an image of the new scale against the upsampled base; each view is upsampled once."""

    def __init__(self, truth: Callable[[Camera], Tensor], scale: float, config: AdaptConfig) -> None:
        """`truth`: returns the base's own image of a view. Raises the errors of `find_upsampler`."""
        self._truth, self._scale, self._config = truth, scale, config
        self._enlarge = find_upsampler(config.upsampler)
        self._targets: dict[Camera, tuple[Tensor, Tensor]] = {}

    def prepare(self, views: Sequence[Camera], seconds: float) -> list[Camera]:
        """Upsample the views beforehand, as many as are expected to take so many seconds, and at least one; return those, in their order.

        Each may take seconds. If there is no time for all, those that are upsampled look from all sides.
        """
        order = spread(halves_of(range(len(views)), poses(views)), torch.Generator().manual_seed(self._config.seed))
        device, done = self._truth(views[order[0]]).device, []
        began = now(device)
        for number in Bar(order, desc=f"upsampling x{self._scale:g}", unit="view"):
            self._target(views[number])
            done.append(number)
            if (now(device) - began) * (len(done) + 1) / len(done) > seconds:
                break
        return [views[number] for number in sorted(done)]

    def __call__(self, view: Camera, image: Tensor) -> Tensor:
        """Return the loss of `image` [H, W, 3], the render of a view of the base scale at the new scale."""
        target, confidence = (tensor.to(image) for tensor in self._target(view))
        confidence = resize(confidence, view.zoomed(self._scale).size, "bilinear")
        return self._config.detail_weight * (confidence * self._difference(image, target, confidence)).mean()

    def _difference(self, image: Tensor, target: Tensor, confidence: Tensor) -> Tensor:
        """The weighted differences of an image from its target: [H, W, 3]."""
        structure, contrast = self._config.detail_structure, self._config.detail_contrast
        difference = (1 - structure) * (image - target).abs()
        if structure == contrast == 0:
            return difference
        ssim, contrast_similarity = similarity(image, target)
        return difference + structure * (1 - ssim) + contrast * confidence**CONTRAST_POWER * (1 - contrast_similarity)

    def _target(self, view: Camera) -> tuple[Tensor, Tensor]:
        if view not in self._targets:
            target, confidence = self._make_target(view)
            self._targets[view] = moved_off_full_gpu(target.half()), moved_off_full_gpu(confidence)  # a hundred photographs are gigabytes
        return self._targets[view]

    @torch.no_grad()
    def _make_target(self, view: Camera) -> tuple[Tensor, Tensor]:
        """The fused target [H, W, 3] and its confidence, [h, w, 1] in 0..1."""
        base, size = self._truth(view), view.zoomed(self._scale).size
        enlarged = self._enlarge(base, size)
        residual = self._residual(enlarged, base)
        confidence = 1 / (1 + residual.square().mean(-1, keepdim=True) / TRUST**2) ** 2
        for _ in range(ROUNDS):
            enlarged = enlarged + resize(self._residual(enlarged, base), size, "pil-bicubic")
        return enlarged.clamp(0, 1), confidence

    def _residual(self, enlarged: Tensor, base: Tensor) -> Tensor:
        """The base's image [h, w, 3] minus the enlarged image, shrunk to its size."""
        return base - resize(enlarged, (base.shape[0], base.shape[1]), self._config.resize)
