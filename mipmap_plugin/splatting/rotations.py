"""Rotations: quaternions (wxyz) and matrices."""

from __future__ import annotations

import torch
from torch import Tensor

# Quaternions whose largest component is smaller are treated as zero, whose rotation is the identity: the gradient grows as the norm shrinks, and its
# square, which Adam takes, would overflow float32. 3DGS draws them so too: it divides by 1e-12 at least (torch's `normalize`).
LEAST_QUATERNION = 1e-15


def rotations(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions wxyz [N, 4] of any norm; a zero quaternion is the identity."""
    return as_if_unit(unit(quats))


def as_if_unit(quats: Tensor) -> Tensor:
    """The matrices [N, 3, 3] of quaternions wxyz [N, 4] by the formula for a norm of 1. They are rotations only for that norm, and for 0."""
    w, x, y, z = quats.unbind(-1)
    entries = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
               2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
               2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]  # fmt: skip
    return torch.unflatten(torch.stack(entries, -1), -1, (3, 3))


def unit(quats: Tensor) -> Tensor:
    """Normalize quaternions [N, 4]; a zero quaternion stays zero."""
    scaled, zero = _scaled(quats, quats.new_zeros(()))
    # `where` before the root: its gradient at 0 is infinite, and infinity times zero is NaN.
    return scaled * torch.where(zero, 1.0, scaled.square().sum(-1, keepdim=True)).rsqrt()


def unit_quaternions(quats: Tensor) -> Tensor:
    """Normalize quaternions [N, 4], with a finite gradient everywhere; a zero quaternion becomes the identity."""
    scaled, _ = _scaled(quats, quats.new_tensor([1.0, 0.0, 0.0, 0.0]))
    unit: Tensor = scaled / scaled.norm(dim=1, keepdim=True)
    return unit


def _scaled(quats: Tensor, of_zero: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternions [N, 4] divided by their largest component, so that squares do not overflow; and which of them are zero, [N, 1].

    Zero ones become `of_zero`. No gradient flows through the component, which is exact: what is normalized next does not depend on it.
    """
    largest = quats.detach().abs().amax(-1, keepdim=True)
    zero = largest < LEAST_QUATERNION
    # `where` before the division as well as after: its gradient at 0 is infinite, and infinity times zero is NaN.
    return torch.where(zero, of_zero, quats / torch.where(zero, 1.0, largest)), zero


def quaternions(rotation: Tensor) -> Tensor:
    """Quaternions wxyz [N, 4] of rotation matrices [N, 3, 3], computed from the largest component (Shepperd 1978), so that nothing cancels."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in rotation.unbind(-2))
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], dim=1)
    w, x, y, z = squares.unbind(-1)
    rows = [
        torch.stack([w, zy - yz, xz - zx, yx - xy], dim=1),
        torch.stack([zy - yz, x, yx + xy, xz + zx], dim=1),
        torch.stack([xz - zx, yx + xy, y, zy + yz], dim=1),
        torch.stack([yx - xy, xz + zx, zy + yz, z], dim=1),
    ]
    quats = torch.stack(rows, dim=1)[torch.arange(len(rotation), device=rotation.device), squares.argmax(dim=1)]
    unit: Tensor = quats / quats.norm(dim=1, keepdim=True)
    return unit


def quaternion_product(first: Tensor, second: Tensor) -> Tensor:
    """The Hamilton product of quaternions wxyz [N, 4]: the rotation `second`, then `first`."""
    w, v = first[:, :1], first[:, 1:]
    u, x = second[:, :1], second[:, 1:]
    return torch.cat([w * u - (v * x).sum(1, keepdim=True), w * x + u * v + torch.cross(v, x, dim=1)], dim=1)
