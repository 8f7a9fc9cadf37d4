"""Real spherical harmonics up to degree 4: view-dependent color.

Constants and order are those of PlenOctrees (sxyu/plenoctree, Apache-2.0), shared by every 3DGS code base.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
      -0.4570457994644658, 1.445305721320277, -0.5900435899266435)  # fmt: skip
C4 = (2.5033429417967046, -1.7701307697799304, 0.9461746957575601, -0.6690465435572892, 0.10578554691520431,
      -0.6690465435572892, 0.47308734787878004, -1.7701307697799304, 0.6258357354491761)  # fmt: skip

# Of the factors of a rotation: the last digits depend on where in memory they are computed, and the same file has to give the same bytes.
DECIMALS = 12


def basis(directions: Tensor, degree: int) -> Tensor:
    """Basis functions [N, (degree + 1)²] at unit directions [N, 3]."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    bands = [[torch.full_like(x, C0)]]
    if degree > 0:
        bands.append([-C1 * y, C1 * z, -C1 * x])
    if degree > 1:
        bands.append([C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy), C2[3] * x * z, C2[4] * (xx - yy)])
    if degree > 2:
        bands.append([C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, C3[2] * y * (4 * zz - xx - yy),
                      C3[3] * z * (2 * zz - 3 * xx - 3 * yy), C3[4] * x * (4 * zz - xx - yy),
                      C3[5] * z * (xx - yy), C3[6] * x * (xx - 3 * yy)])  # fmt: skip
    if degree > 3:
        bands.append([C4[0] * x * y * (xx - yy), C4[1] * y * z * (3 * xx - yy), C4[2] * x * y * (7 * zz - 1),
                      C4[3] * y * z * (7 * zz - 3), C4[4] * (zz * (35 * zz - 30) + 3), C4[5] * x * z * (7 * zz - 3),
                      C4[6] * (xx - yy) * (7 * zz - 1), C4[7] * x * z * (xx - 3 * yy),
                      C4[8] * (xx * (xx - 3 * yy) - yy * (3 * xx - yy))])  # fmt: skip
    return torch.stack([function for band in bands for function in band], -1)


def colors(sh: Tensor, means: Tensor, eye: Tensor, degree: int) -> Tensor:
    """Linear RGB [N, 3] of splats at `means` [N, 3] seen from `eye` [3]: SH + 0.5, clamped to at least 0, no upper bound.

    In the dtype of `sh`; `means` and `eye` may be in a finer one, in which far from the origin the directions are as exact as elsewhere.
    """
    if degree == 0:  # independent of the direction
        return (C0 * sh[:, 0]).add(0.5).clamp_min(0)
    bands = (degree + 1) ** 2
    rays = means - eye
    # A splat exactly at the eye has no direction: any unit vector will do, as long as it and its gradient are finite.
    length = rays.norm(dim=-1, keepdim=True)
    at_eye = length == 0
    directions = torch.where(at_eye, rays.new_tensor([0.0, 0.0, 1.0]), rays / torch.where(at_eye, 1.0, length))
    return (basis(directions.to(sh), degree)[..., None] * sh[:, :bands]).sum(1).add(0.5).clamp_min(0)


def rotated(sh: Tensor, rotation: Tensor) -> Tensor:
    """Coefficients [N, (degree + 1)², 3] of splats that were turned by `rotation` [3, 3]: their color towards R d is what it was towards d.

    A basis function of turned directions is a sum of those of its own degree; the factors are solved for in float64.
    """
    degree = math.isqrt(sh.shape[1]) - 1
    directions = torch.randn(4 * sh.shape[1], 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    directions = directions / directions.norm(dim=1, keepdim=True)
    factors: Tensor = torch.linalg.lstsq(basis(directions, degree), basis(directions @ rotation.double(), degree)).solution
    factors = factors.round(decimals=DECIMALS) + 0.0  # and no -0
    turned: Tensor = factors.to(sh) @ sh
    return turned
