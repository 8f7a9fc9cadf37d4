"""Eigenvalues and eigenvectors of many symmetric 3 x 3 matrices at once, in a fixed number of steps on any device.

`torch.linalg.eigh` uses a solver for large matrices: on GPUs it is slow for large batches, and their size is limited.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.rotations import quaternions

# Jacobi's method converges quadratically: four sweeps take any matrix to double precision. One to spare.
SWEEPS = 5


@torch.no_grad()
def eigh3(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues [N, 3], ascending, and eigenvectors [N, 3, 3], in columns, of symmetric [N, 3, 3]; as `torch.linalg.eigh`. No gradient.

    The cyclic Jacobi method (Golub and Van Loan, Matrix Computations, 8.5): each rotation zeroes one off-diagonal entry, by the smaller
    of the two possible angles. Equal eigenvalues are not a special case, as they are for a cubic. Matrices are scaled first, so that
    squares do not overflow; the absolute error of small eigenvalues is the rounding error of the largest.
    """
    largest = matrices.abs().amax((1, 2), keepdim=True)
    scaled = matrices / torch.where(largest > 0, largest, 1.0)
    diagonal = [scaled[:, k, k] for k in range(3)]
    off = [scaled[:, 1, 2], scaled[:, 2, 0], scaled[:, 0, 1]]  # off[k]: the entry whose row and column are not k
    vectors = [torch.eye(3, dtype=matrices.dtype, device=matrices.device)[k].expand(len(matrices), 3) for k in range(3)]
    for _ in range(SWEEPS):
        for r, p, q in ((2, 0, 1), (1, 2, 0), (0, 1, 2)):
            tan = _tangent(off[r], diagonal[q] - diagonal[p])
            cos = (1 + tan.square()).rsqrt()
            sin = tan * cos
            change = tan * off[r]
            diagonal[p], diagonal[q], off[r] = diagonal[p] - change, diagonal[q] + change, torch.zeros_like(change)
            off[q], off[p] = cos * off[q] - sin * off[p], sin * off[q] + cos * off[p]
            c, s = cos[:, None], sin[:, None]
            vectors[p], vectors[q] = c * vectors[p] - s * vectors[q], s * vectors[p] + c * vectors[q]
    values, order = torch.stack(diagonal, 1).sort(dim=1)
    return values * largest[:, :, 0], torch.stack(vectors, 2).gather(2, order[:, None].expand_as(matrices))


def _tangent(off: Tensor, gap: Tensor) -> Tensor:
    """Tangent, at most 1, of the rotation that zeroes the entry `off` [N] between two axes whose diagonal entries differ by `gap` [N]."""
    # 2·off / (gap ± sqrt(gap² + 4·off²)), with the sign for which both terms agree.
    below = gap.abs() + torch.hypot(gap, 2 * off)
    return torch.where(below > 0, 2 * off * torch.where(gap < 0, -1.0, 1.0) / torch.where(below > 0, below, 1.0), 0.0)


def by_axes(gaussians: Gaussians) -> Gaussians:
    """The same splats, their covariances as quaternions and scales. No gradient."""
    if gaussians.covariances is None:
        return gaussians
    quats, scales = quats_and_scales(gaussians.covariances.detach().double())
    return replace(gaussians, quats=quats.to(gaussians.quats), scales=scales.to(gaussians.scales), covariances=None)


def quats_and_scales(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternions wxyz [N, 4] and scales [N, 3] of splats with these covariances [N, 3, 3]. No gradient."""
    variances, directions = eigh3(covariances)
    directions = directions * torch.linalg.det(directions).sign()[:, None, None]  # rotations, not reflections
    return quaternions(directions), variances.clamp_min(0).sqrt()
