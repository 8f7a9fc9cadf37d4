"""The gradients of losses, against autograd's of their definitions."""

import pytest
import torch

from mipmap_plugin.adaptation.optimization.losses import INVISIBLE_ERROR, gradient_of

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


def test_an_image_that_is_right_has_no_gradient():
    gradient, square_error = gradient_of(torch.zeros(2, 2, 3), "psnr")
    assert not gradient.any() and square_error == 0
