"""Image quality: PSNR, and SSIM from scikit-image with the literature's settings."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from mipmap_plugin.adaptation.curve import decibel
from mipmap_plugin.errors import ShapeError

# Wang et al. 2004, with the window of all splatting papers: an 11 x 11 Gaussian of sigma 1.5.
SSIM_WINDOW = 11
SSIM_SIGMA = 1.5

# The PSNR (dB) of identical images, which occur among 8-bit ones. It is finite, so that means are.
SAME_DB = decibel(0.0)


def psnr(image: Tensor, truth: Tensor) -> float:
    """PSNR in dB of two images [H, W, 3], both clamped to 0..1; at most SAME_DB, and NaN if one contains NaN. Raises ShapeError."""
    if image.shape != truth.shape:
        raise ShapeError(f"an image {list(image.shape)} cannot be compared with one {list(truth.shape)}")
    return decibel(float(np.mean((_array(image) - _array(truth)) ** 2)))


def ssim(image: Tensor, truth: Tensor) -> float | None:
    """Mean structural similarity of two images [H, W, 3] clamped to 0..1; None for an image smaller than the window.

    Images are padded with black, as by the code of the papers: without their border, which is a fifth of a picture of 100 px, SSIM is another figure.
    """
    if min(image.shape[:2]) < SSIM_WINDOW:
        return None
    from skimage.metrics import structural_similarity  # here, because it loads all of scipy's statistics, which takes half a second

    border = SSIM_WINDOW // 2  # which scikit-image leaves out
    padded = [np.pad(_array(each), ((border, border), (border, border), (0, 0))) for each in (truth, image)]
    settings = dict(gaussian_weights=True, sigma=SSIM_SIGMA, use_sample_covariance=False)
    return float(structural_similarity(*padded, data_range=1.0, channel_axis=2, **settings))


def _array(image: Tensor) -> np.ndarray:
    return image.detach().clamp(0, 1).double().cpu().numpy()
