"""Windows: occlusion by an edge, and sizes at which the integrals would cancel or overflow."""

import importlib.util
import math

import numpy as np
import pytest
import torch

from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.backends.supersample import render
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.window import WIDE, differences, moments

needs_numba = pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="numba, the extra `cpu`, is not installed")
BACKENDS = [ReferenceBackend(), pytest.param(CpuBackend(), marks=needs_numba)]
VIEW = Camera(5, 5, 10.0, 10.0, 2.5, 2.5, torch.eye(4))
WINDOW = Effects(0, "window", 0.0)


def facing(*splats: tuple[float, float, float, float], opacity: float = 1.0) -> Gaussians:
    """Splats that face the camera, one behind the other: center from the image's middle and standard deviations along x and y, px."""
    depths = 3 + 0.1 * torch.arange(len(splats), dtype=torch.float64)
    x, y, wide, high = torch.tensor(splats, dtype=torch.float64).T * depths / 10
    count = len(splats)
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(count, 1)
    colors = torch.linspace(-0.5, 1, count, dtype=torch.float64)[:, None, None].repeat(1, 1, 3)
    return Gaussians(torch.stack([x, y, depths], 1), quats, torch.stack([wide, high, 0 * x], 1), torch.full((count,), opacity).double(), colors)


def test_an_edge_occludes_only_what_lies_behind_it():
    """The edge of a wall over the left of the middle pixel; behind it a splat in the pixel's left or right."""

    def alpha(*splats):
        return float(ReferenceBackend().render(facing(*splats), VIEW, WINDOW).alpha[2, 2])

    wall, left, right = [(-2.0, 0.0, 0.6, 30.0)] * 30, (-0.35, 0.0, 0.05, 0.5), (0.35, 0.0, 0.05, 0.5)
    front = alpha(*wall)
    hidden = [1 - (alpha(*wall, place) - front) / alpha(place) for place in (left, right)]
    assert 0.2 < front < 0.4 and hidden[0] > 1.5 * hidden[1], (front, hidden)


def test_it_is_closer_to_supersampling_than_the_analytic_filter():
    rng = torch.Generator().manual_seed(0)
    g = facing(*(4 * torch.rand(60, 4, generator=rng) - 2 + torch.tensor([0, 0, 2.2, 2.2])).mul(torch.tensor([1, 1, 0.3, 0.3])).tolist(), opacity=0.8)
    truth = render(ReferenceBackend(), g, VIEW, Effects(0, "classic", 0.0, supersampling=32)).image
    window, square = (ReferenceBackend().render(g, VIEW, Effects(0, name, 0.0)).image for name in ("window", "analytic"))
    assert (window - truth).square().mean() < 0.25 * (square - truth).square().mean()


def panels(count):
    """Nodes and weights of an integral over -1/2..1/2: `count` pieces of 20 Gauss-Legendre points."""
    nodes, weights = (torch.from_numpy(part) / (2 * count) for part in np.polynomial.legendre.leggauss(20))
    middles = (torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5
    return (middles[:, None] + nodes).flatten(), weights.repeat(count)


@pytest.mark.parametrize("sigma", [1e-3, 0.1, 0.6, 1 / WIDE, 0.7, 1.0, 30.0, 1e4])
def test_float32_loses_nothing_at_any_width(sigma):
    u = torch.linspace(-3 * sigma - 1, 3 * sigma + 1, 1001, dtype=torch.float64)
    nodes, weights = panels(100)
    shares = weights * torch.exp(-0.5 * ((u[:, None] + nodes) / sigma) ** 2)
    computed = moments(u.float(), torch.ones(1001), torch.tensor(sigma).float())
    for moment, exact in zip(computed, (shares, nodes * shares, nodes**2 * shares), strict=True):
        torch.testing.assert_close(moment.double(), exact.sum(-1), rtol=0, atol=3e-6)


@pytest.mark.parametrize("backend", BACKENDS, ids=["reference", "cpu"])
def test_extreme_splats_have_finite_gradients(backend):
    sizes = ((2, 2), (3, 1), (1, 3), (2, 1e-9), (1e-9, 1e-9), (1e6, 1e6), (5, 1e-3), (0.3, 0.3))
    g = facing(*((0.1, 0.2, *size) for size in sizes), opacity=0.9).to(dtype=torch.float32)
    leaves = [t.clone().requires_grad_() for t in (g.means, g.quats, g.scales, g.opacities, g.sh)]
    image = backend.render(Gaussians(*leaves), VIEW, WINDOW).image
    gradients = torch.autograd.grad(image.square().sum(), leaves)
    assert torch.isfinite(image).all() and all(torch.isfinite(gradient).all() for gradient in gradients)
    assert gradients[2][:3, :2].any()


def test_dilation_adds_to_the_variance():
    wide = ReferenceBackend().render(facing((0.2, 0.1, math.hypot(0.5, 0.4), 0.5)), VIEW, WINDOW)
    dilated = ReferenceBackend().render(facing((0.2, 0.1, 0.5, 0.3)), VIEW, Effects(0, "window", 0.16))
    torch.testing.assert_close(dilated.image, wide.image, atol=1e-9, rtol=0)


@pytest.mark.parametrize("edge", ["first", "last"])
def test_the_gradient_is_right_where_an_edge_passes_through_the_center(edge):
    """There the absolute value of its distance has no slope."""
    width, sigma = torch.tensor(0.5, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)
    at = width / 2 if edge == "first" else -width / 2
    u = at.clone().requires_grad_()
    differences(u, width, sigma)[0].backward()
    step = 1e-6
    above, below = (differences(at + sign * step, width, sigma)[0] for sign in (1, -1))
    assert float(u.grad) == pytest.approx(float(above - below) / (2 * step), rel=1e-6)
