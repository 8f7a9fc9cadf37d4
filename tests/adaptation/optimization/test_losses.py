"""The gradients of losses, against autograd's of their definitions."""

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.curve import INVISIBLE_ERROR
from mipmap_plugin.adaptation.optimization.losses import BEYOND_WHITE, compare, gradient_of
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import wrap_model

DEFINITIONS = {
    "l1": lambda difference: difference.abs().mean(),
    "l2": lambda difference: difference.square().mean(),
    "psnr": lambda difference: (difference.square().mean() + INVISIBLE_ERROR).log(),
}


@pytest.mark.parametrize("loss", DEFINITIONS)
def test_gradients_are_those_of_the_definition(loss):
    difference = torch.randn(5, 7, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()
    [expected] = torch.autograd.grad(DEFINITIONS[loss](difference), difference)
    gradient, square_error = gradient_of(difference.detach(), loss)
    torch.testing.assert_close(gradient, expected)
    torch.testing.assert_close(square_error, difference.detach().square().mean())


@pytest.mark.parametrize("loss", DEFINITIONS)
def test_those_of_several_images_are_those_of_each(loss):
    differences = torch.randn(4, 5, 7, 3, generator=torch.Generator().manual_seed(0))
    gradients, square_errors = gradient_of(differences, loss)
    for number, difference in enumerate(differences):
        gradient, square_error = gradient_of(difference, loss)
        torch.testing.assert_close(gradients[number], gradient)
        torch.testing.assert_close(square_errors[number], square_error)


COMPARED = {
    "zoom-out": (1 / 4, dict(loss="psnr"), (6, 8), lambda image, truth: image.minimum(truth.clamp_min(1) + BEYOND_WHITE)),
    "zoom-out by another loss": (1 / 4, dict(loss="l2"), (6, 8), lambda image, truth: image),
    "zoom-in to the base": (2, dict(loss="psnr", compare_at="base"), (3, 4), lambda image, truth: image.clamp_max(1)),
    "zoom-in to what is upsampled": (2, dict(loss="psnr", compare_at="target"), (6, 8), lambda image, truth: image),
}


@pytest.mark.parametrize("name", COMPARED)
@pytest.mark.parametrize("detail", [None, lambda view, image: image.square().mean()], ids=["", "with detail"])
@pytest.mark.parametrize("count", [1, 2])
def test_the_gradient_of_an_image_is_that_of_the_loss_of_what_a_display_shows(name, detail, count):
    scale, settings, size, shown = COMPARED[name]
    generator, config = torch.Generator().manual_seed(0), AdaptConfig(resize="pil-bicubic", **settings)
    images = 2.0 * torch.rand(count, 6, 8, 3, generator=generator, dtype=torch.float64)
    truths = 1.1 * torch.rand(count, *size, 3, generator=generator, dtype=torch.float64)
    for image, truth, found in zip(images, truths, compare([None] * count, images, truths, config, scale, detail), strict=True):
        leaf = shown(image, truth).requires_grad_()
        difference = resize(leaf, size, "pil-bicubic") - truth
        [gradient] = torch.autograd.grad(DEFINITIONS[config.loss](difference) + (detail(None, leaf) if detail else 0), leaf)
        torch.testing.assert_close(found, (gradient, difference.detach().square().mean()))


def test_an_image_that_is_right_has_no_gradient():
    gradient, square_error = gradient_of(torch.zeros(2, 2, 3), "psnr")
    assert not gradient.any() and square_error == 0


@pytest.mark.parametrize("scale", [2, 1 / 2, 1 / 4])
def test_steps_leave_what_a_display_cannot_show(scale):
    """Colors up to twenty times white: steps that make all of it white do nothing for the rest."""
    splats = tiny.gaussians(60)
    splats.sh.mul_(30)
    base = wrap_model(VanillaModel.from_gaussians(splats), cameras=tiny.cameras(2, width=32, height=24), backend="reference")
    psnrs = base.adapt(scale, steps=20, views="given", merge_to=1.0, check_every=20).report.validation
    assert psnrs["the last state"] > psnrs["the start, the closed form"] + 0.5


@pytest.mark.parametrize(("shown", "truth", "excess"), [(3.0, 0.9, 0.12), (3.0, 1.0, 0.02), (3.0, 1.07, 0.02), (1.06, 1.07, -0.01), (0.5, 1.0, -0.5)])
def test_an_image_is_not_made_brighter_than_a_truth_that_is_brighter_than_white(shown, truth, excess):
    """As a bicubic filter makes truths beside edges. An image that counted as at most 1.02 there was made brighter without end."""
    image, target = (torch.full((2, 2, 3), color) for color in (shown, truth))
    [(gradient, square_error)] = compare([None], [image], [target], AdaptConfig(loss="psnr"), 1 / 4, None)
    assert bool((gradient.sign() == torch.tensor(excess).sign()).all()) and float(square_error) == pytest.approx(excess**2, rel=1e-3)
