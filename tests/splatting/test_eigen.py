"""Eigenvalues and eigenvectors of 3 x 3 matrices against torch's, on ordinary, equal, flat, needle-like, tiny and huge ones."""

import pytest
import torch

from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.eigen import by_axes, eigh3
from mipmap_plugin.splatting.projection import covariances_of
from mipmap_plugin.splatting.rotations import quaternions, rotations


def turned(variances: torch.Tensor, seed: int = 0) -> torch.Tensor:
    """[N, 3, 3] with these eigenvalues [N, 3], turned at random."""
    quats = torch.randn(len(variances), 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    turn = rotations(quats)
    matrices = turn @ torch.diag_embed(variances) @ turn.mT
    return (matrices + matrices.mT) / 2


def of(*variances: float, count: int = 500) -> torch.Tensor:
    return turned(torch.tensor([variances], dtype=torch.float64).repeat(count, 1))


MATRICES = {
    "ordinary": turned(torch.rand(2000, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)),
    "indefinite": turned(torch.randn(2000, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)),
    "round": of(1.0, 1.0, 1.0),
    "disc": of(1.0, 1.0, 1e-8),
    "needle": of(1.0, 1e-12, 1e-12),
    "almost round": of(1.0, 1.0 + 1e-9, 1.0 - 1e-9),
    "two of a kind": of(2.0, 2.0, 1.0),
    "flat": of(1.0, 0.5, 0.0),
    "zero": torch.zeros(3, 3, 3, dtype=torch.float64),
    "of all ratios": turned(10 ** (-12 * torch.rand(2000, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64))),
    "huge": of(1e200, 3e199, 1e-200),
    "tiny": of(1e-200, 3e-201, 2e-210),
    "diagonal": torch.diag_embed(torch.tensor([[3.0, 1.0, 2.0], [1.0, 1.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)),
    "no splat": torch.zeros(0, 3, 3, dtype=torch.float64),
}


@pytest.mark.parametrize("name", MATRICES)
def test_it_equals_torchs(name):
    matrices = MATRICES[name]
    values, vectors = eigh3(matrices)
    size = matrices.abs().amax((1, 2), keepdim=True) if len(matrices) else matrices
    rounding = 4e-15 * size
    assert ((values - torch.linalg.eigvalsh(matrices)).abs() <= rounding[:, 0]).all()
    assert (values.diff(dim=1) >= 0).all()
    assert ((vectors @ torch.diag_embed(values) @ vectors.mT - matrices).abs() <= 2 * rounding).all()
    torch.testing.assert_close(vectors.mT @ vectors, torch.eye(3, dtype=torch.float64).expand_as(vectors), atol=4e-15, rtol=0)


def test_quaternions_of_rotations_are_those_that_made_them():
    """Whichever of their numbers is the largest."""
    quats = torch.nn.functional.normalize(torch.cat([torch.eye(4), torch.randn(50, 4, generator=torch.Generator().manual_seed(0))]).double())
    found = quaternions(rotations(quats))
    torch.testing.assert_close(found * (found * quats).sum(1, keepdim=True).sign(), quats)


def test_splats_of_any_covariances_have_axes_and_no_reflections():
    covariances = MATRICES["ordinary"][:50]
    splats = Gaussians(torch.zeros(50, 3), torch.ones(50, 4), torch.ones(50, 3), torch.ones(50), torch.zeros(50, 1, 3), covariances.float())
    torch.testing.assert_close(covariances_of(by_axes(splats)).double(), covariances, atol=1e-5, rtol=0)
