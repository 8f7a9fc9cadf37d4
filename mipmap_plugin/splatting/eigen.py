"""Eigenvalues and eigenvectors of many symmetric 3 x 3 matrices at once, in a fixed number of steps on any device.

`torch.linalg.eigh` hands each of them to a solver for large ones: on GPUs slow for many, and limited in their number.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Each sweep of Jacobi's method more than squares what is left off the diagonal: four take any matrix to the rounding of double. One to spare.
SWEEPS = 5


@torch.no_grad()
def eigh3(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Symmetric [N, 3, 3] -> eigenvalues [N, 3], ascending, and eigenvectors [N, 3, 3], in columns; as `torch.linalg.eigh`.

    The cyclic Jacobi method (Golub and Van Loan, Matrix Computations, 8.5): each turn zeroes one entry off the diagonal by the smaller
    of the two angles that do. No cubic is solved, so that equal eigenvalues need no case of their own. Numbers are scaled first, so that
    no square leaves the range; small eigenvalues are as exact as the rounding of the largest. Without gradient.
    """
    largest = matrices.abs().amax((1, 2), keepdim=True)
    scaled = matrices / torch.where(largest > 0, largest, 1.0)
    diagonal = [scaled[:, k, k] for k in range(3)]
    off = [scaled[:, 1, 2], scaled[:, 2, 0], scaled[:, 0, 1]]  # each under the index that is not its own
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
    """[N]: the tangent, at most 1, of the turn after which nothing is left of `off`, between two axes whose entries differ by `gap`."""
    # 2·off / (gap ± sqrt(gap² + 4·off²)), of which both terms have one sign.
    below = gap.abs() + torch.hypot(gap, 2 * off)
    return torch.where(below > 0, 2 * off * torch.where(gap < 0, -1.0, 1.0) / torch.where(below > 0, below, 1.0), 0.0)
