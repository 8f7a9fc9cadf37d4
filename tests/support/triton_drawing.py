"""What the tests of the Triton kernels in Triton's interpreter share: how a scene is drawn, and what it is compared with."""

import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch
from samples import camera

from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.backends.triton import TritonBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians

MISSING = importlib.util.find_spec("triton") is None
MARKS = [
    pytest.mark.interpreter,
    pytest.mark.skipif(MISSING or os.environ.get("TRITON_INTERPRET") != "1", reason="triton is not installed, or TRITON_INTERPRET is not 1"),
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # numpy's, about infinities, on which a GPU does not warn
]


# Two by three tiles, the last ones cropped; off center, fx != fy.
WIDE = camera(40, 24, 30.0, 26.0, cx=18.3, cy=13.9)


def draw(backend, g: Gaussians, view, effects: Effects):
    """Image, alpha, and the gradients of a fixed weighted sum of all pixels by the name of the tensor."""
    g = Gaussians(**{name: tensor.detach().clone().requires_grad_() for name, tensor in g.tensors().items()})
    rendered = backend(g, view, effects)
    image, alpha = (rendered.image, rendered.alpha) if hasattr(rendered, "image") else rendered
    weights = torch.randn(*alpha.shape, 4, generator=torch.Generator().manual_seed(7), dtype=torch.float64).to(image)
    ((image * weights[..., :3]).sum() + (alpha * weights[..., 3]).sum()).backward()
    return image.detach(), alpha.detach(), {name: tensor.grad for name, tensor in g.tensors().items() if tensor.grad is not None}


def triton_result(g: Gaussians, view=WIDE, effects: Effects = Effects(1)):  # noqa: B008
    return draw(TritonBackend().render, g.to(dtype=torch.float32), view, effects)


def reference_result(g: Gaussians, view=WIDE, effects: Effects = Effects(1)):  # noqa: B008
    return draw(ReferenceBackend().render, g.to(dtype=torch.float64), view, effects)


def assert_equal(actual, expected, relative=2e-5):
    for what, right in zip(actual[:2], expected[:2], strict=True):
        torch.testing.assert_close(what.double(), right, atol=5e-6, rtol=0)
    for name, grad in actual[2].items():
        assert (grad.double() - expected[2][name]).norm() <= relative * expected[2][name].norm(), name


@contextmanager
def deterministic(on: bool) -> Iterator[None]:
    """Whether sums are made in one order; torch then also fills new memory with NaN, so that reading uninitialized memory would be noticed."""
    torch.use_deterministic_algorithms(on)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(False)
