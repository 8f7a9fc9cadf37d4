"""PSNR is scikit-image's, without loading it."""

import math

import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio

from mipmap_plugin.errors import ShapeError
from mipmap_plugin.evaluation.metrics import SAME_DB, psnr


def test_psnr_is_that_of_scikit_image():
    image, truth = torch.rand(2, 12, 10, 3, generator=torch.Generator().manual_seed(0)).double()
    assert psnr(image, truth) == pytest.approx(peak_signal_noise_ratio(truth.numpy(), image.numpy(), data_range=1.0), abs=1e-9)
    assert psnr(truth, truth) == SAME_DB


def test_what_cannot_be_compared_has_no_psnr():
    """NaN is not the best that there is."""
    picture = torch.rand(4, 4, 3)
    assert math.isnan(psnr(torch.full_like(picture, math.nan), picture))
    with pytest.raises(ShapeError, match=r"an image \[4, 4, 3\] cannot be compared with one \[4, 4, 1\]"):
        psnr(picture, picture[:, :, :1])
