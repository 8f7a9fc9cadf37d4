"""r(x): every filter against the library that it says it equals, and upsamplers by name."""

import numpy as np
import pytest
import torch
from PIL import Image

from mipmap_plugin.adaptation.target import upsamplers
from mipmap_plugin.adaptation.target.resampling import matrix_of
from mipmap_plugin.adaptation.target.resize import gradient_before, resize
from mipmap_plugin.adaptation.target.upsamplers import UPSAMPLERS, register_upsampler
from mipmap_plugin.errors import SettingsError

SMALLER, LARGER = (7, 10), (50, 45)


@pytest.fixture
def image():
    return torch.rand(24, 30, 3, generator=torch.Generator().manual_seed(0))


def pillow(image, size, method):
    """Pillow's own resize, plane by plane in 32-bit floats."""
    planes = [Image.fromarray(image[..., c].numpy()).resize((size[1], size[0]), method) for c in range(3)]
    return torch.from_numpy(np.stack(planes, -1))


def two_taps(image, size):
    """Bilinear between the four nearest pixel centers, one pixel at a time; the border is repeated."""
    out = torch.empty(*size, 3)
    for row in range(size[0]):
        for column in range(size[1]):
            y = min(max((row + 0.5) * image.shape[0] / size[0] - 0.5, 0), image.shape[0] - 1)
            x = min(max((column + 0.5) * image.shape[1] / size[1] - 0.5, 0), image.shape[1] - 1)
            top, left = int(y), int(x)
            bottom, right = min(top + 1, image.shape[0] - 1), min(left + 1, image.shape[1] - 1)
            upper = torch.lerp(image[top, left], image[top, right], x - left)
            out[row, column] = torch.lerp(upper, torch.lerp(image[bottom, left], image[bottom, right], x - left), y - top)
    return out


@pytest.mark.parametrize("size", [SMALLER, LARGER, (8, 45)])
@pytest.mark.parametrize(("method", "pillows"), [("pil-bicubic", Image.Resampling.BICUBIC), ("lanczos", Image.Resampling.LANCZOS)])
def test_cubic_and_lanczos_equal_pillow(image, method, pillows, size):
    torch.testing.assert_close(resize(image, size, method), pillow(image, size, pillows), atol=2e-6, rtol=0)


@pytest.mark.parametrize("method", ["box", "area"])
def test_box_and_area_are_the_mean_of_whole_blocks(image, method):
    torch.testing.assert_close(resize(image, (6, 10), method), image.view(6, 4, 10, 3, 3).mean(dim=(1, 3)))


@pytest.mark.parametrize("size", [SMALLER, (24, 7), LARGER])
def test_box_refuses_what_is_not_a_whole_multiple(image, size):
    with pytest.raises(SettingsError, match=rf"box: \[24, 30\] px is not a whole multiple of \[{size[0]}, {size[1]}\] px; use area"):
        resize(image, size, "box")


@pytest.mark.parametrize(("old", "new"), [(3, 2), (4, 3), (208, 160), (2, 3)])
def test_area_counts_a_pixel_by_how_much_of_it_is_covered(old, new):
    """The integral of a row of pixels, between the borders of the new ones."""
    row = torch.rand(old, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    whole = np.concatenate([[0], np.cumsum(row.numpy())])
    borders = np.interp(np.arange(new + 1) * old / new, np.arange(old + 1), whole)
    made = resize(row[None, :, None].repeat(1, 1, 3), (1, new), "area")
    np.testing.assert_allclose(made[0, :, 0], np.diff(borders) * new / old)


@pytest.mark.parametrize("size", [SMALLER, LARGER])
def test_bilinear_has_two_taps_and_no_prefilter(image, size):
    torch.testing.assert_close(resize(image, size, "bilinear"), two_taps(image, size), atol=1e-5, rtol=0)


@pytest.mark.parametrize("method", ["box", "area", "bilinear", "pil-bicubic", "lanczos"])
def test_a_constant_stays_and_the_same_size_is_the_same_image(image, method):
    torch.testing.assert_close(resize(torch.full((24, 30, 3), 0.7), (6, 10), method), torch.full((6, 10, 3), 0.7))
    assert resize(image, (24, 30), method) is image


@pytest.mark.parametrize("size", [SMALLER, LARGER, (8, 45)])
@pytest.mark.parametrize("method", ["area", "bilinear", "pil-bicubic", "lanczos"])
def test_gradients_are_those_of_finite_differences(method, size):
    image = torch.rand(13, 15, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda image: resize(image, size, method), image, fast_mode=True)


@pytest.mark.parametrize("size", [SMALLER, LARGER, (8, 45), (24, 30)])
@pytest.mark.parametrize("method", ["area", "pil-bicubic"])
def test_the_gradient_before_is_that_of_autograd(image, method, size):
    image.requires_grad_()
    small = resize(image, size, method)
    gradient = torch.rand(small.shape, generator=torch.Generator().manual_seed(1))
    small.backward(gradient)
    torch.testing.assert_close(gradient_before(gradient, (24, 30), method), image.grad)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_any_floating_point_type_stays(image, dtype):
    small = resize(image.to(dtype), SMALLER, "lanczos")
    assert small.dtype == dtype
    torch.testing.assert_close(small.float(), resize(image, SMALLER, "lanczos"), atol=8 * torch.finfo(dtype).eps + 1e-6, rtol=0)


@pytest.mark.parametrize(("count", "wanted"), [(1, 9), (9, 1), (5187, 648), (7, 7000)])
def test_one_pixel_and_thousands(count, wanted):
    row = torch.rand(count, 1, 1, generator=torch.Generator().manual_seed(0))
    found = resize(row, (wanted, 1), "lanczos")[:, 0, 0]
    expected = Image.fromarray(row[:, :, 0].numpy()).resize((1, wanted), Image.Resampling.LANCZOS)
    torch.testing.assert_close(found, torch.from_numpy(np.array(expected))[:, 0], atol=3e-6, rtol=0)


def test_weights_are_made_once_a_size(image):
    before = matrix_of.cache_info().misses
    for _ in range(3):
        resize(image, (11, 13), "lanczos")
    assert matrix_of.cache_info().misses == before + 2  # one for each axis


@pytest.mark.parametrize(("name", "pillows"), [("bicubic", Image.Resampling.BICUBIC), ("lanczos", Image.Resampling.LANCZOS)])
def test_built_in_upsamplers_equal_pillow(image, name, pillows):
    torch.testing.assert_close(UPSAMPLERS.get(name)(image, LARGER), pillow(image, LARGER, pillows), atol=2e-6, rtol=0)


def test_an_upsampler_is_registered_as_a_function_or_as_a_string(image):
    register_upsampler("mine", lambda image, size: image.new_zeros(*size, 3))
    register_upsampler("also-mine", "mipmap_plugin.adaptation.target.upsamplers:lanczos")
    assert UPSAMPLERS.get("mine")(image, LARGER).shape == (*LARGER, 3)
    assert UPSAMPLERS.get("also-mine") is upsamplers.lanczos
    assert {"mine", "also-mine"} <= set(UPSAMPLERS.names())
