"""A capture whose view-dependent colors were trained toward its cameras alone."""

import math

import torch

from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.harmonics import basis

COUNT, FAR = 1500, 6.0


def draws(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def cameras(far: float = FAR) -> torch.Tensor:
    """Places [C, 3] on the half of a ring around the scene, a little above it."""
    turn = torch.linspace(0, math.pi, 24, dtype=torch.float64)
    return far * torch.nn.functional.normalize(torch.stack([turn.cos(), torch.full_like(turn, -0.2), turn.sin()], 1), dim=1)


def table() -> torch.Tensor:
    """Places of splats [N, 3]: most on a table, a tenth far behind it."""
    means = 4 * torch.rand(COUNT, 3, generator=draws(0), dtype=torch.float64) - 2
    means[: COUNT // 10] *= 10
    return means


def capture(far: float = FAR) -> Gaussians:
    """Splats whose colors are noise that was fitted toward the cameras: what steps of gradient descent from 0 can make of their bands."""
    means = table()
    rays = torch.nn.functional.normalize(means - cameras(far)[:, None], dim=2)
    noise = torch.randn(len(rays), COUNT, 3, generator=draws(1), dtype=torch.float64)
    sh = torch.einsum("vnk,vnc->nkc", basis(rays.flatten(0, 1), 3).unflatten(0, rays.shape[:2]), noise) / 100
    sizes = 0.01 + 0.09 * torch.rand(COUNT, 1, generator=draws(2), dtype=torch.float64)
    turned = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(COUNT, 4)
    return Gaussians(means, turned, sizes.expand(COUNT, 3), torch.full((COUNT,), 0.8, dtype=torch.float64), sh)
