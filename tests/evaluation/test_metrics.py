"""PSNR is scikit-image's, without loading it, and SSIM that of the literature."""

import math

import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio

from mipmap_plugin.errors import ShapeError
from mipmap_plugin.evaluation.metrics import SAME_DB, psnr, ssim


def noise(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def test_psnr_is_that_of_scikit_image():
    image, truth = noise(2, 12, 10, 3).double()
    assert psnr(image, truth) == pytest.approx(peak_signal_noise_ratio(truth.numpy(), image.numpy(), data_range=1.0), abs=1e-9)
    assert psnr(truth, truth) == SAME_DB


def test_psnr_is_of_what_a_screen_shows():
    truth = noise(8, 9, 3)
    assert psnr(truth + 5, truth) == pytest.approx(psnr(torch.ones(8, 9, 3), truth))


def test_what_cannot_be_compared_has_no_psnr():
    """NaN is not the best that there is."""
    picture = noise(4, 4, 3)
    assert math.isnan(psnr(torch.full_like(picture, math.nan), picture))
    with pytest.raises(ShapeError, match=r"an image \[4, 4, 3\] cannot be compared with one \[4, 4, 1\]"):
        psnr(picture, picture[:, :, :1])


def gaussian_window_ssim(image, truth):
    """Wang et al. 2004 by hand: an 11 x 11 Gaussian window of sigma 1.5 around each pixel, with black around the image, as in the papers' code."""
    offsets = torch.arange(11, dtype=torch.float64) - 5
    line = (-(offsets**2) / (2 * 1.5**2)).exp()
    window = (line[:, None] * line / line.sum() ** 2)[None, None]
    blur = lambda planes: torch.nn.functional.conv2d(planes, window, padding=5)  # noqa: E731
    x, y = (each.double().movedim(-1, 0)[:, None] for each in (image, truth))
    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return float(((2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))).mean())


def test_ssim_has_the_literatures_window():
    image = noise(20, 24, 3)
    truth = (image + 0.2 * noise(20, 24, 3, seed=1)).clamp(0, 1)
    assert ssim(image, truth) == pytest.approx(gaussian_window_ssim(image, truth), abs=1e-6)
    assert ssim(image, image) == pytest.approx(1.0)


def test_ssim_is_not_known_for_an_image_smaller_than_its_window():
    assert ssim(noise(10, 30, 3), noise(10, 30, 3)) is None
    assert ssim(noise(11, 11, 3), noise(11, 11, 3)) == pytest.approx(1.0)
