"""Differentiable structural similarity per pixel (Wang et al. 2004, with the parameters of all splatting papers)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d

# An 11 x 11 Gaussian window of sigma 1.5, and the constants that keep the ratios finite in flat or dark areas, for images in 0..1.
RADIUS, SIGMA = 5, 1.5
LUMINANCE_FLOOR, CONTRAST_FLOOR = 0.01**2, 0.03**2

# Added to the product of two variances, to keep its root differentiable; it is so small that flat areas come out only 2 % too similar.
LEAST_CONTRAST = 1e-10


def similarity(image: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """SSIM of two images [H, W, C] in 0..1 at each pixel, and its contrast term, both [H, W, C].

    The contrast term (Wang et al. 2004, equation 9) is 1 where both have the same local variance, whatever their structure. Images are
    padded with black.
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
    """Geometric mean of variances, which rounding may leave below 0; its gradient is finite where one of them is 0."""
    return (a.clamp_min(0) * b.clamp_min(0) + LEAST_CONTRAST).sqrt()


def _blurred(images: Tensor) -> Tensor:
    """Blur images [..., H, W] with the window."""
    offsets = torch.arange(-RADIUS, RADIUS + 1, device=images.device, dtype=images.dtype)
    weights = torch.softmax(-offsets.square() / (2 * SIGMA**2), 0)
    channels = images.reshape(-1, *images.shape[-2:])
    count = len(channels)  # a group per channel is fourteen times as fast as a batch of single-channel images
    across = conv2d(channels, weights.expand(count, 1, 1, -1), padding=(0, RADIUS), groups=count)
    return conv2d(across, weights[:, None].expand(count, 1, -1, 1), padding=(RADIUS, 0), groups=count).view(images.shape)
