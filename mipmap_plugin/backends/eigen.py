"""Eigenvalues and eigenvectors of many symmetric 3 x 3 matrices at once, in a fixed number of steps on any device.

`torch.linalg.eigh` hands each of them to a solver for large ones: on GPUs slow for many, and limited in their number.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Jacobi's method squares what is left off the diagonal with each sweep: in double, three or four sweeps take any matrix to rounding.
SWEEPS = 6
PAIRS = ((0, 1), (0, 2), (1, 2))


def eigh3(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Symmetric [N, 3, 3] -> eigenvalues [N, 3], ascending, and eigenvectors [N, 3, 3], in columns; as `torch.linalg.eigh`.

    The cyclic Jacobi method (Golub and Van Loan, Matrix Computations, 8.5): each turn zeroes one entry off the diagonal by the smaller
    of the two angles that do. No determinant or cubic is solved, so that equal eigenvalues need no case of their own. Small eigenvalues
    are as exact as the largest one's rounding; numbers are scaled first, so that no square leaves the range. Has no gradient of use.
    """
    largest = matrices.abs().amax((1, 2), keepdim=True)
    scaled = matrices / torch.where(largest > 0, largest, 1.0)
    vectors = torch.eye(3, dtype=matrices.dtype, device=matrices.device).expand_as(matrices).clone()
    for _ in range(SWEEPS):
        for p, q in PAIRS:
            turn = _turn(scaled, p, q)
            scaled, vectors = turn.mT @ scaled @ turn, vectors @ turn
    values, order = scaled.diagonal(dim1=1, dim2=2).sort(dim=1)
    return values * largest[:, :, 0], vectors.gather(2, order[:, None].expand_as(vectors))


def _turn(matrices: Tensor, p: int, q: int) -> Tensor:
    """[N, 3, 3]: rotations R by at most 45 degrees so that RᵀMR has nothing at (p, q)."""
    off, gap = matrices[:, p, q], matrices[:, q, q] - matrices[:, p, p]
    # tan of the smaller angle: 2·off / (gap ± sqrt(gap² + 4·off²)), whose sum has both terms of one sign.
    below = gap.abs() + torch.hypot(gap, 2 * off)
    tan = torch.where(below > 0, 2 * off * torch.where(gap < 0, -1.0, 1.0) / torch.where(below > 0, below, 1.0), 0.0)
    cos = (1 + tan.square()).rsqrt()
    turn = torch.eye(3, dtype=matrices.dtype, device=matrices.device).repeat(len(matrices), 1, 1)
    turn[:, p, p] = turn[:, q, q] = cos
    turn[:, p, q], turn[:, q, p] = tan * cos, -tan * cos
    return turn
