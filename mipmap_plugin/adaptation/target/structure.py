"""Structural similarity with a gradient, pixel by pixel (Wang et al. 2004, as every splatting paper sets it)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d

# An 11 x 11 Gaussian window of sigma 1.5, and what keeps flat and dark places from dividing by nothing: (0.01, 0.03)², of images in 0..1.
RADIUS, SIGMA = 5, 1.5
LUMINANCE_FLOOR, CONTRAST_FLOOR = 0.01**2, 0.03**2

# Beside a product of two variances: a hundredth of the floor, squared. Two flat images are 2 % more alike than they can be.
LEAST_CONTRAST = 1e-10


def similarity(image: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """SSIM at each pixel of two images [H, W, C] in 0..1, [H, W, C], and the part of it that compares how strong their contrasts are.

    That part (Wang et al. 2004, equation 9) is 1 where both vary as much, wherever they do. Beyond their borders both are black.
    """
    a, b = image.permute(2, 0, 1), truth.permute(2, 0, 1)
    mean_a, mean_b, square_a, square_b, product = _blurred(torch.stack([a, b, a * a, b * b, a * b]))
    both, squares = mean_a * mean_b, mean_a.square() + mean_b.square()
    luminance = (2 * both + LUMINANCE_FLOOR) / (squares + LUMINANCE_FLOOR)
    variances = square_a + square_b - squares + CONTRAST_FLOOR
    ssim = luminance * (2 * (product - both) + CONTRAST_FLOOR) / variances
    contrast = (2 * _geometric_mean(square_a - mean_a.square(), square_b - mean_b.square()) + CONTRAST_FLOOR) / variances
    return ssim.permute(1, 2, 0), contrast.permute(1, 2, 0)


def _geometric_mean(a: Tensor, b: Tensor) -> Tensor:
    """Of variances, which rounding may leave below 0; its slope is finite where one of them is 0."""
    return (a.clamp_min(0) * b.clamp_min(0) + LEAST_CONTRAST).sqrt()


def _blurred(images: Tensor) -> Tensor:
    """[..., H, W] under the window."""
    offsets = torch.arange(-RADIUS, RADIUS + 1, device=images.device, dtype=images.dtype)
    weights = torch.softmax(-offsets.square() / (2 * SIGMA**2), 0)
    channels = images.reshape(-1, *images.shape[-2:])
    count = len(channels)  # one group each: fourteen times as fast as a batch of images with one channel
    across = conv2d(channels, weights.expand(count, 1, 1, -1), padding=(0, RADIUS), groups=count)
    return conv2d(across, weights[:, None].expand(count, 1, -1, 1), padding=(RADIUS, 0), groups=count).view(images.shape)
