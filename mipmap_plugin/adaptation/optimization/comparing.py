"""The comparison of a step's images with their truths, as far as a display shows them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.losses import gradient_of
from mipmap_plugin.adaptation.optimization.run import Task
from mipmap_plugin.adaptation.target.resize import difference_from, gradient_before
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig

# A display shows white, 1, at most: what is brighter, as a sky may be by far, would outweigh all else. At zoom-out so much of it counts, as otherwise
# steps leave colors too bright for views that they did not see: lego and chair lose 1.7 and 2.6 dB at x1/4. At zoom-in nothing does. Beside an edge
# a truth is brighter than white too, for a bicubic filter overshoots: there so much beyond the truth counts.
BEYOND_WHITE = 0.02


def compare(
    task: Task, config: AdaptConfig, views: Sequence[Camera], images: Sequence[Tensor], targets: Sequence[Tensor]
) -> list[tuple[Tensor, Tensor]]:
    """The gradient of the loss of each view's image, [h, w, 3], and its mean square error, [].

    In one operation where images are of one size, since a GPU waits for each.
    """
    if len(images) == 1 or task.detail is not None or len({image.shape for image in (*images, *targets)}) > 1:
        return [_compare_one(task, config, *each) for each in zip(views, images, targets, strict=True)]
    target = torch.stack(list(targets))
    gradients, square_errors = gradient_of(_shown(torch.stack(list(images)).detach(), target, task, config) - target, config.loss)
    return list(zip(gradients.unbind(), square_errors.unbind(), strict=True))


def _shown(image: Tensor, target: Tensor, task: Task, config: AdaptConfig) -> Tensor:
    """An image [..., h, w, 3] as far as a display shows it, which counts (BEYOND_WHITE). It is not changed in place: a backend may still need it."""
    if task.scale > 1 and config.compare_at == "base":
        return image.clamp_max(1)
    return image.minimum(target.clamp_min(1) + BEYOND_WHITE) if task.scale <= 1 and config.loss == "psnr" else image


def _compare_one(task: Task, config: AdaptConfig, view: Camera, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    image = _shown(image.detach(), target, task, config)
    if task.detail is None:
        gradient, square_error = gradient_of(difference_from(target, image, config.resize), config.loss)
        return gradient_before(gradient, (image.shape[0], image.shape[1]), config.resize), square_error
    difference = difference_from(target, image.requires_grad_(), config.resize)
    gradient, square_error = gradient_of(difference.detach(), config.loss)
    further = task.detail(view, image)
    [whole] = torch.autograd.grad((difference, further), image, (gradient, torch.ones_like(further)))
    return whole, square_error
