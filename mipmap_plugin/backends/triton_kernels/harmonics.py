"""Real spherical harmonics as in `splatting/harmonics.py`, one direction per lane, and their gradients."""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin.backends.triton_kernels.vectors import add3
from mipmap_plugin.splatting import harmonics

C0 = tl.constexpr(harmonics.C0)
C1 = tl.constexpr(harmonics.C1)
C20, C21, C22, C23, C24 = (tl.constexpr(c) for c in harmonics.C2)
C30, C31, C32, C33, C34, C35, C36 = (tl.constexpr(c) for c in harmonics.C3)
C40, C41, C42, C43, C44, C45, C46, C47, C48 = (tl.constexpr(c) for c in harmonics.C4)


@triton.jit
def _add(red, green, blue, sh, weight, at: tl.constexpr, mask):
    """(red, green, blue) + weight · coefficient `at`."""
    red += weight * tl.load(sh + 3 * at, mask, 0.0)
    green += weight * tl.load(sh + 3 * at + 1, mask, 0.0)
    blue += weight * tl.load(sh + 3 * at + 2, mask, 0.0)
    return red, green, blue


@triton.jit
def color(sh, x, y, z, mask, DEGREE: tl.constexpr):
    """Red, green, blue [B] in unit directions, before 0.5 is added and negative values are clamped. `sh` [B]: pointers to the coefficients."""
    zero = tl.zeros_like(x)
    r, g, b = _add(zero, zero, zero, sh, zero + C0, 0, mask)
    if DEGREE > 0:
        r, g, b = _add(r, g, b, sh, y * -C1, 1, mask)
        r, g, b = _add(r, g, b, sh, z * C1, 2, mask)
        r, g, b = _add(r, g, b, sh, x * -C1, 3, mask)
    xx, yy, zz = x * x, y * y, z * z
    if DEGREE > 1:
        r, g, b = _add(r, g, b, sh, x * C20 * y, 4, mask)
        r, g, b = _add(r, g, b, sh, y * C21 * z, 5, mask)
        r, g, b = _add(r, g, b, sh, (2 * zz - xx - yy) * C22, 6, mask)
        r, g, b = _add(r, g, b, sh, x * C23 * z, 7, mask)
        r, g, b = _add(r, g, b, sh, (xx - yy) * C24, 8, mask)
    if DEGREE > 2:
        r, g, b = _add(r, g, b, sh, y * C30 * (3 * xx - yy), 9, mask)
        r, g, b = _add(r, g, b, sh, x * C31 * y * z, 10, mask)
        r, g, b = _add(r, g, b, sh, y * C32 * (4 * zz - xx - yy), 11, mask)
        r, g, b = _add(r, g, b, sh, z * C33 * (2 * zz - 3 * xx - 3 * yy), 12, mask)
        r, g, b = _add(r, g, b, sh, x * C34 * (4 * zz - xx - yy), 13, mask)
        r, g, b = _add(r, g, b, sh, z * C35 * (xx - yy), 14, mask)
        r, g, b = _add(r, g, b, sh, x * C36 * (xx - 3 * yy), 15, mask)
    if DEGREE > 3:
        r, g, b = _add(r, g, b, sh, x * C40 * y * (xx - yy), 16, mask)
        r, g, b = _add(r, g, b, sh, y * C41 * z * (3 * xx - yy), 17, mask)
        r, g, b = _add(r, g, b, sh, x * C42 * y * (7 * zz - 1), 18, mask)
        r, g, b = _add(r, g, b, sh, y * C43 * z * (7 * zz - 3), 19, mask)
        r, g, b = _add(r, g, b, sh, (zz * (35 * zz - 30) + 3) * C44, 20, mask)
        r, g, b = _add(r, g, b, sh, x * C45 * z * (7 * zz - 3), 21, mask)
        r, g, b = _add(r, g, b, sh, (xx - yy) * C46 * (7 * zz - 1), 22, mask)
        r, g, b = _add(r, g, b, sh, x * C47 * z * (xx - 3 * yy), 23, mask)
        r, g, b = _add(r, g, b, sh, (xx * (xx - 3 * yy) - yy * (3 * xx - yy)) * C48, 24, mask)
    return r, g, b


@triton.jit
def _add_back(sh, d_sh, weight, d_red, d_green, d_blue, at: tl.constexpr, drawn, inside, further):
    """Backward pass of `_add`: add the gradient of coefficient `at`, return that of its basis function `weight`."""
    add3(d_sh + 3 * at, weight * d_red, weight * d_green, weight * d_blue, inside, further)
    d_weight = d_red * tl.load(sh + 3 * at, drawn, 0.0) + d_green * tl.load(sh + 3 * at + 1, drawn, 0.0)
    return d_weight + d_blue * tl.load(sh + 3 * at + 2, drawn, 0.0)


@triton.jit
def _band_1(sh, d_sh, x, y, z, d_red, d_green, d_blue, drawn, inside, further):
    dy = _add_back(sh, d_sh, y * -C1, d_red, d_green, d_blue, 1, drawn, inside, further) * -C1
    dz = _add_back(sh, d_sh, z * C1, d_red, d_green, d_blue, 2, drawn, inside, further) * C1
    dx = _add_back(sh, d_sh, x * -C1, d_red, d_green, d_blue, 3, drawn, inside, further) * -C1
    return dx, dy, dz


@triton.jit
def _band_2(sh, d_sh, x, y, z, d_red, d_green, d_blue, drawn, inside, further):
    xx, yy, zz = x * x, y * y, z * z
    dx, dy, dz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    p = _add_back(sh, d_sh, x * C20 * y, d_red, d_green, d_blue, 4, drawn, inside, further) * C20
    dx, dy = dx + p * y, dy + p * x
    p = _add_back(sh, d_sh, y * C21 * z, d_red, d_green, d_blue, 5, drawn, inside, further) * C21
    dy, dz = dy + p * z, dz + p * y
    p = _add_back(sh, d_sh, (2 * zz - xx - yy) * C22, d_red, d_green, d_blue, 6, drawn, inside, further) * C22
    dx, dy, dz = dx - 2 * p * x, dy - 2 * p * y, dz + 4 * p * z
    p = _add_back(sh, d_sh, x * C23 * z, d_red, d_green, d_blue, 7, drawn, inside, further) * C23
    dx, dz = dx + p * z, dz + p * x
    p = _add_back(sh, d_sh, (xx - yy) * C24, d_red, d_green, d_blue, 8, drawn, inside, further) * C24
    dx, dy = dx + 2 * p * x, dy - 2 * p * y
    return dx, dy, dz


@triton.jit
def _band_3(sh, d_sh, x, y, z, d_red, d_green, d_blue, drawn, inside, further):
    xx, yy, zz = x * x, y * y, z * z
    dx, dy, dz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    p = _add_back(sh, d_sh, y * C30 * (3 * xx - yy), d_red, d_green, d_blue, 9, drawn, inside, further) * C30
    dx, dy = dx + 6 * p * x * y, dy + 3 * p * (xx - yy)
    p = _add_back(sh, d_sh, x * C31 * y * z, d_red, d_green, d_blue, 10, drawn, inside, further) * C31
    dx, dy, dz = dx + p * y * z, dy + p * x * z, dz + p * x * y
    p = _add_back(sh, d_sh, y * C32 * (4 * zz - xx - yy), d_red, d_green, d_blue, 11, drawn, inside, further) * C32
    dx, dy, dz = dx - 2 * p * x * y, dy + p * (4 * zz - xx - 3 * yy), dz + 8 * p * y * z
    p = _add_back(sh, d_sh, z * C33 * (2 * zz - 3 * xx - 3 * yy), d_red, d_green, d_blue, 12, drawn, inside, further) * C33
    dx, dy, dz = dx - 6 * p * x * z, dy - 6 * p * y * z, dz + p * (6 * zz - 3 * xx - 3 * yy)
    p = _add_back(sh, d_sh, x * C34 * (4 * zz - xx - yy), d_red, d_green, d_blue, 13, drawn, inside, further) * C34
    dx, dy, dz = dx + p * (4 * zz - 3 * xx - yy), dy - 2 * p * x * y, dz + 8 * p * x * z
    p = _add_back(sh, d_sh, z * C35 * (xx - yy), d_red, d_green, d_blue, 14, drawn, inside, further) * C35
    dx, dy, dz = dx + 2 * p * x * z, dy - 2 * p * y * z, dz + p * (xx - yy)
    p = _add_back(sh, d_sh, x * C36 * (xx - 3 * yy), d_red, d_green, d_blue, 15, drawn, inside, further) * C36
    dx, dy = dx + 3 * p * (xx - yy), dy - 6 * p * x * y
    return dx, dy, dz


@triton.jit
def _band_4(sh, d_sh, x, y, z, d_red, d_green, d_blue, drawn, inside, further):
    xx, yy, zz = x * x, y * y, z * z
    dx, dy, dz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    p = _add_back(sh, d_sh, x * C40 * y * (xx - yy), d_red, d_green, d_blue, 16, drawn, inside, further) * C40
    dx, dy = dx + p * y * (3 * xx - yy), dy + p * x * (xx - 3 * yy)
    p = _add_back(sh, d_sh, y * C41 * z * (3 * xx - yy), d_red, d_green, d_blue, 17, drawn, inside, further) * C41
    dx, dy, dz = dx + 6 * p * x * y * z, dy + 3 * p * z * (xx - yy), dz + p * y * (3 * xx - yy)
    p = _add_back(sh, d_sh, x * C42 * y * (7 * zz - 1), d_red, d_green, d_blue, 18, drawn, inside, further) * C42
    dx, dy, dz = dx + p * y * (7 * zz - 1), dy + p * x * (7 * zz - 1), dz + 14 * p * x * y * z
    p = _add_back(sh, d_sh, y * C43 * z * (7 * zz - 3), d_red, d_green, d_blue, 19, drawn, inside, further) * C43
    dy, dz = dy + p * z * (7 * zz - 3), dz + p * y * (21 * zz - 3)
    p = _add_back(sh, d_sh, (zz * (35 * zz - 30) + 3) * C44, d_red, d_green, d_blue, 20, drawn, inside, further) * C44
    dz += p * z * (140 * zz - 60)
    p = _add_back(sh, d_sh, x * C45 * z * (7 * zz - 3), d_red, d_green, d_blue, 21, drawn, inside, further) * C45
    dx, dz = dx + p * z * (7 * zz - 3), dz + p * x * (21 * zz - 3)
    p = _add_back(sh, d_sh, (xx - yy) * C46 * (7 * zz - 1), d_red, d_green, d_blue, 22, drawn, inside, further) * C46
    dx, dy, dz = dx + 2 * p * x * (7 * zz - 1), dy - 2 * p * y * (7 * zz - 1), dz + 14 * p * z * (xx - yy)
    p = _add_back(sh, d_sh, x * C47 * z * (xx - 3 * yy), d_red, d_green, d_blue, 23, drawn, inside, further) * C47
    dx, dy, dz = dx + 3 * p * z * (xx - yy), dy - 6 * p * x * y * z, dz + p * x * (xx - 3 * yy)
    p = _add_back(sh, d_sh, (xx * (xx - 3 * yy) - yy * (3 * xx - yy)) * C48, d_red, d_green, d_blue, 24, drawn, inside, further) * C48
    dx, dy = dx + 4 * p * x * (xx - 3 * yy), dy + 4 * p * y * (yy - 3 * xx)
    return dx, dy, dz


@triton.jit
def color_back(sh, d_sh, x, y, z, d_red, d_green, d_blue, drawn, inside, further, DEGREE: tl.constexpr):
    """Backward pass of `color`: add the gradients of the coefficients `inside` at the pointers `d_sh` [B], return those of x, y, z.

    d_red, d_green and d_blue are 0 where not `drawn`.
    """
    _add_back(sh, d_sh, tl.zeros_like(x) + C0, d_red, d_green, d_blue, 0, drawn, inside, further)
    dx, dy, dz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    if DEGREE >= 1:
        px, py, pz = _band_1(sh, d_sh, x, y, z, d_red, d_green, d_blue, drawn, inside, further)
        dx, dy, dz = dx + px, dy + py, dz + pz
    if DEGREE >= 2:
        px, py, pz = _band_2(sh, d_sh, x, y, z, d_red, d_green, d_blue, drawn, inside, further)
        dx, dy, dz = dx + px, dy + py, dz + pz
    if DEGREE >= 3:
        px, py, pz = _band_3(sh, d_sh, x, y, z, d_red, d_green, d_blue, drawn, inside, further)
        dx, dy, dz = dx + px, dy + py, dz + pz
    if DEGREE >= 4:
        px, py, pz = _band_4(sh, d_sh, x, y, z, d_red, d_green, d_blue, drawn, inside, further)
        dx, dy, dz = dx + px, dy + py, dz + pz
    return dx, dy, dz
