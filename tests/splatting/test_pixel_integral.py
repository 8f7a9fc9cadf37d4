"""The integral over a pixel where its published formula breaks: round, axis-aligned, flat, much wider and much thinner than a pixel."""

import importlib.util
import math

import pytest
import torch
from oracle import below

from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.pixel_integral import BOUND, CUBIC, LINEAR, integral

needs_numba = pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="numba, the extra `cpu`, is not installed")
VIEW = Camera(24, 18, 30.0, 30.0, 12.0, 9.0, torch.eye(4))
ANALYTIC = Effects(0, "analytic", 0.0)


def facing(*sizes: tuple[float, float], turned: float = 0.0) -> Gaussians:
    """Flat splats on the optical axis that face the camera, one behind the other; standard deviations in px, turned by an angle."""
    depths = 3 + 0.1 * torch.arange(len(sizes))
    means = torch.stack([torch.zeros_like(depths), torch.zeros_like(depths), depths], 1)
    scales = torch.tensor([[*size, 0.0] for size in sizes]) * depths[:, None] / 30
    quats = torch.tensor([[math.cos(turned / 2), 0.0, 0.0, math.sin(turned / 2)]]).repeat(len(sizes), 1)
    return Gaussians(means, quats, scales, torch.full((len(sizes),), 0.5), torch.full((len(sizes), 1, 3), 0.4))


@pytest.mark.parametrize("backend", [ReferenceBackend(), pytest.param(CpuBackend(), marks=needs_numba)], ids=["reference", "cpu"])
@pytest.mark.parametrize("turned", [0.0, math.pi / 2])
def test_round_flat_and_axis_aligned_splats_have_finite_gradients(backend, turned):
    g = facing((2, 2), (3, 1), (1, 3), (2, 0), (0, 0), (1e3, 1e3), (5, 1e-3), turned=turned)
    leaves = [t.clone().requires_grad_() for t in (g.means, g.quats, g.scales, g.opacities, g.sh)]
    image = backend.render(Gaussians(*leaves), VIEW, ANALYTIC).image
    gradients = torch.autograd.grad(image.square().sum(), leaves)
    assert torch.isfinite(image).all() and image.max() > 0.3
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert gradients[2][:3, :2].all()  # the sizes of the visible ones


@pytest.mark.parametrize("sigma", [2e-3, 0.1, 1.0, 30.0, 1e4])
def test_float32_loses_nothing_at_any_width(sigma):
    u = torch.linspace(-3 * sigma - 2, 3 * sigma + 2, 1001)
    width = torch.tensor(sigma).double()
    exact = width * (below((u.double() + 0.5) / width) - below((u.double() - 0.5) / width))
    torch.testing.assert_close(integral(u, torch.tensor(sigma)).double(), exact, rtol=2e-4 if sigma < 0.01 else 1e-5, atol=1e-7)


def test_the_sum_over_pixels_is_the_integral_of_the_splat():
    """While alpha is small, the sum over all pixels is opacity · 2π · σ_long · σ_short."""
    for size in ((0.3, 0.05), (1.5, 0.7), (2.0, 2.0)):
        g = facing(size, turned=0.4)
        mass = 0.5 * 2 * math.pi * size[0] * size[1]
        tail = 1 / 255 * 24 * 18 / 4  # below 1/255 nothing is drawn
        assert abs(float(ReferenceBackend().render(g, VIEW, ANALYTIC).alpha.sum()) - mass) < min(tail, 0.1 * mass + 0.05)


def test_the_bound_holds():
    x = torch.linspace(0, 12, 100_001, dtype=torch.float64)
    fallen = torch.exp(-x * (LINEAR + CUBIC * x**2))
    density = (LINEAR + 3 * CUBIC * x**2) * fallen / (1 + fallen) ** 2
    assert 0.999 * BOUND < (density / (torch.exp(-(x**2) / 2) / math.sqrt(2 * math.pi))).max() < BOUND
    assert (density.diff() <= 0).all()
