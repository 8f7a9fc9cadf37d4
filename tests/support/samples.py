"""Small random scenes for the tests, all from a seed."""

import torch

from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians


def camera(width=40, height=32, fx=45.0, fy=42.0, cx=None, cy=None) -> Camera:
    """A view along +z from the origin, turned a little."""
    turn = torch.tensor([[0.9950, 0.0, 0.0998], [0.0, 1.0, 0.0], [-0.0998, 0.0, 0.9950]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.linalg.qr(turn)[0] * torch.linalg.qr(turn)[1].diag().sign()
    viewmat[:3, 3] = torch.tensor([0.1, -0.05, 0.2])
    return Camera(width, height, fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy, viewmat)


def gaussians(n=60, degree=1, seed=0, dtype=torch.float64) -> Gaussians:
    """Splats in front of `camera()`, some behind it and some off screen; opacities from faint to opaque."""
    rng = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.rand(*shape, generator=rng, dtype=torch.float64)  # noqa: E731
    means = (rand(n, 3) - 0.5) * torch.tensor([3.0, 2.4, 5.0]) + torch.tensor([0.0, 0.0, 3.0])
    parts = (means, rand(n, 4) - 0.5, 0.02 + 0.25 * rand(n, 3) ** 2, 0.02 + 0.97 * rand(n), rand(n, (degree + 1) ** 2, 3) - 0.3)
    return Gaussians(*(part.to(dtype) for part in parts))


def leaves(g: Gaussians) -> tuple[list[torch.Tensor], Gaussians]:
    """The same splats over fresh leaf tensors: (means, quats, scales, opacities, sh), Gaussians."""
    tensors = [t.detach().clone().requires_grad_() for t in (g.means, g.quats, g.scales, g.opacities, g.sh)]
    return tensors, Gaussians(*tensors)


def t2_camera() -> Camera:
    """FORMATS §13, T2: a view whose vectors are published."""
    rows = [[0.726315789, -0.610526316, -0.315789474, 0.5], [0.526315789, 0.789473684, -0.315789474, -0.25],
            [0.442105263, 0.063157895, 0.894736842, 4.0], [0, 0, 0, 1]]  # fmt: skip
    return Camera(64, 48, 70.0, 72.0, 32.0, 24.0, torch.tensor(rows, dtype=torch.float64))


def t3_gaussian() -> Gaussians:
    """FORMATS §13, T3: a splat in it."""
    t = lambda *x: torch.tensor([x], dtype=torch.float64)  # noqa: E731
    return Gaussians(t(0.1, 0.2, 0.3), t(1, 0.5, -0.5, 0.25), t(0.2, 0.1, 0.05), torch.sigmoid(t(1.0))[0], t(0.5, -0.3, 0.1)[:, None])
