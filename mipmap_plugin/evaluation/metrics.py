"""Image quality. PSNR and SSIM come from scikit-image, with the literature's settings."""

from __future__ import annotations

import numpy as np
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import Tensor

# Wang et al. 2004, as every splatting paper sets it: an 11 x 11 Gaussian window of sigma 1.5.
SSIM_WINDOW = 11
SSIM_SIGMA = 1.5


def psnr(image: Tensor, truth: Tensor) -> float:
    """dB between two images [H, W, 3], both clamped to 0..1."""
    return float(peak_signal_noise_ratio(_array(truth), _array(image), data_range=1.0))


def ssim(image: Tensor, truth: Tensor) -> float | None:
    """Mean structural similarity of two images [H, W, 3] clamped to 0..1; None for an image smaller than the window."""
    if min(image.shape[:2]) < SSIM_WINDOW:
        return None
    settings = dict(gaussian_weights=True, sigma=SSIM_SIGMA, use_sample_covariance=False)
    return float(structural_similarity(_array(truth), _array(image), data_range=1.0, channel_axis=2, **settings))


def _array(image: Tensor) -> np.ndarray:
    return image.detach().clamp(0, 1).double().cpu().numpy()
