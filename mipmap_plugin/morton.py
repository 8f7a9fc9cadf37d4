"""Morton codes (1966): integers in whose order places follow a Z-order curve, on which neighbors in space mostly follow each other."""

from __future__ import annotations

from torch import Tensor

# (shift, bits kept): each step moves the bits of a coordinate apart, half as far as the one before, until two zeros follow every bit.
SPREADING = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249))


def morton_codes(cells: Tensor) -> Tensor:
    """The codes [N] of `cells` [N, 3], int64, 0 to 2^21 - 1: the bits of x, y and z take turns, x has the lowest."""
    for shift, kept in SPREADING:
        cells = (cells | cells << shift) & kept
    x, y, z = cells.unbind(1)
    codes: Tensor = x | y << 1 | z << 2
    return codes
