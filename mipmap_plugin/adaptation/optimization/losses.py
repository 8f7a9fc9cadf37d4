"""The losses of an image, by their gradients: all that a step needs, and far less work for autograd than their values."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from mipmap_plugin.adaptation.curve import INVISIBLE_ERROR
from mipmap_plugin.adaptation.target.resize import difference_from, gradient_before
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig

Detail = Callable[[Camera, Tensor], Tensor]  # a view and its image -> a further part of the loss

# A display shows white, 1, at most: what is brighter, as a sky may be by far, would outweigh all else. At zoom-out so much of it counts, as otherwise
# steps leave colors too bright for views that they did not see: lego and chair lose 1.7 and 2.6 dB at x1/4. At zoom-in nothing does. Beside an edge
# a truth is brighter than white too, for a bicubic filter overshoots: there so much beyond the truth counts.
BEYOND_WHITE = 0.02


def compare(
    views: Sequence[Camera], images: Sequence[Tensor], targets: Sequence[Tensor], config: AdaptConfig, scale: float, detail: Detail | None
) -> list[tuple[Tensor, Tensor]]:
    """The gradient of the loss of each view's image, [h, w, 3], and its mean square error, []; `scale`, `detail`: as of `Task`.

    In one operation where images are of one size, since a GPU waits for each.
    """
    if len(images) == 1 or detail is not None or len({image.shape for image in (*images, *targets)}) > 1:
        return [_compare_one(*each, config, scale, detail) for each in zip(views, images, targets, strict=True)]
    target = torch.stack(list(targets))
    gradients, square_errors = gradient_of(_shown(torch.stack(list(images)).detach(), target, config, scale) - target, config.loss)
    return list(zip(gradients.unbind(), square_errors.unbind(), strict=True))


def _shown(image: Tensor, target: Tensor, config: AdaptConfig, scale: float) -> Tensor:
    """An image [..., h, w, 3] as far as a display shows it, which counts (BEYOND_WHITE). It is not changed in place: a backend may still need it."""
    if scale > 1 and config.compare_at == "base":
        return image.clamp_max(1)
    return image.minimum(target.clamp_min(1) + BEYOND_WHITE) if scale <= 1 and config.loss == "psnr" else image


def _compare_one(view: Camera, image: Tensor, target: Tensor, config: AdaptConfig, scale: float, detail: Detail | None) -> tuple[Tensor, Tensor]:
    image = _shown(image.detach(), target, config, scale)
    if detail is None:
        gradient, square_error = gradient_of(difference_from(target, image, config.resize), config.loss)
        return gradient_before(gradient, (image.shape[0], image.shape[1]), config.resize), square_error
    difference = difference_from(target, image.requires_grad_(), config.resize)
    gradient, square_error = gradient_of(difference.detach(), config.loss)
    # The sum has this gradient in the difference; torch.autograd.grad takes gradients by themselves too, but it loads sympy.
    [whole] = torch.autograd.grad((difference * gradient).sum() + detail(view, image), image)
    return whole, square_error


@torch.no_grad()
def gradient_of(difference: Tensor, loss: str) -> tuple[Tensor, Tensor]:
    """The gradient of a loss (`AdaptConfig.loss`) in the difference from the target, [..., h, w, 3], and the mean square error, [...].

    `psnr` is the logarithm of the mean square error, so that a view that is far off does not outweigh the others.
    """
    flat = difference.flatten(-3)
    count = flat.shape[-1]
    square_error: Tensor = torch.linalg.vecdot(flat, flat) / count
    if loss == "l1":
        return difference.sign() / count, square_error
    if loss == "l2":
        return difference * (2 / count), square_error
    divisor = (square_error + INVISIBLE_ERROR) * (count / 2)
    return difference / divisor.view(*divisor.shape, 1, 1, 1), square_error
