"""Real spherical harmonics as in `splatting/harmonics.py`, and their gradients. A lane has one channel: those of a splat lie side by side."""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin.backends.triton_kernels.vectors import add
from mipmap_plugin.splatting import harmonics

C0 = tl.constexpr(harmonics.C0)
C1 = tl.constexpr(harmonics.C1)
C20, C21, C22, C23, C24 = (tl.constexpr(c) for c in harmonics.C2)
C30, C31, C32, C33, C34, C35, C36 = (tl.constexpr(c) for c in harmonics.C3)
C40, C41, C42, C43, C44, C45, C46, C47, C48 = (tl.constexpr(c) for c in harmonics.C4)


@triton.jit
def at_most(degree, mask, of: tl.constexpr):
    """`mask` where the bands of degree `of` are evaluated, up to the view's `degree`."""
    return tl.where(degree >= of, mask, mask != mask)


@triton.jit
def color(sh, x, y, z, degree, mask, DEGREE: tl.constexpr):
    """Colors [B, channels] in unit directions of that shape, before 0.5 is added and negative values are clamped. `sh`: the first coefficients.

    degree: of the view, which may be less than DEGREE, the largest of the views that are drawn at once.
    """
    value = C0 * tl.load(sh, mask, 0.0)
    if DEGREE > 0:
        mask = at_most(degree, mask, 1)
        value += (y * -C1) * tl.load(sh + 3 * 1, mask, 0.0)
        value += (z * C1) * tl.load(sh + 3 * 2, mask, 0.0)
        value += (x * -C1) * tl.load(sh + 3 * 3, mask, 0.0)
    xx, yy, zz = x * x, y * y, z * z
    if DEGREE > 1:
        mask = at_most(degree, mask, 2)
        value += (x * C20 * y) * tl.load(sh + 3 * 4, mask, 0.0)
        value += (y * C21 * z) * tl.load(sh + 3 * 5, mask, 0.0)
        value += ((2 * zz - xx - yy) * C22) * tl.load(sh + 3 * 6, mask, 0.0)
        value += (x * C23 * z) * tl.load(sh + 3 * 7, mask, 0.0)
        value += ((xx - yy) * C24) * tl.load(sh + 3 * 8, mask, 0.0)
    if DEGREE > 2:
        mask = at_most(degree, mask, 3)
        value += (y * C30 * (3 * xx - yy)) * tl.load(sh + 3 * 9, mask, 0.0)
        value += (x * C31 * y * z) * tl.load(sh + 3 * 10, mask, 0.0)
        value += (y * C32 * (4 * zz - xx - yy)) * tl.load(sh + 3 * 11, mask, 0.0)
        value += (z * C33 * (2 * zz - 3 * xx - 3 * yy)) * tl.load(sh + 3 * 12, mask, 0.0)
        value += (x * C34 * (4 * zz - xx - yy)) * tl.load(sh + 3 * 13, mask, 0.0)
        value += (z * C35 * (xx - yy)) * tl.load(sh + 3 * 14, mask, 0.0)
        value += (x * C36 * (xx - 3 * yy)) * tl.load(sh + 3 * 15, mask, 0.0)
    if DEGREE > 3:
        mask = at_most(degree, mask, 4)
        value += (x * C40 * y * (xx - yy)) * tl.load(sh + 3 * 16, mask, 0.0)
        value += (y * C41 * z * (3 * xx - yy)) * tl.load(sh + 3 * 17, mask, 0.0)
        value += (x * C42 * y * (7 * zz - 1)) * tl.load(sh + 3 * 18, mask, 0.0)
        value += (y * C43 * z * (7 * zz - 3)) * tl.load(sh + 3 * 19, mask, 0.0)
        value += ((zz * (35 * zz - 30) + 3) * C44) * tl.load(sh + 3 * 20, mask, 0.0)
        value += (x * C45 * z * (7 * zz - 3)) * tl.load(sh + 3 * 21, mask, 0.0)
        value += ((xx - yy) * C46 * (7 * zz - 1)) * tl.load(sh + 3 * 22, mask, 0.0)
        value += (x * C47 * z * (xx - 3 * yy)) * tl.load(sh + 3 * 23, mask, 0.0)
        value += ((xx * (xx - 3 * yy) - yy * (3 * xx - yy)) * C48) * tl.load(sh + 3 * 24, mask, 0.0)
    return value


@triton.jit
def _add_back(sh, d_sh, weight, d_color, at: tl.constexpr, drawn, inside, further):
    """Add the gradient of coefficient `at`; return that of its basis function, which is `weight`."""
    add(d_sh + 3 * at, weight * d_color, inside, further)
    return d_color * tl.load(sh + 3 * at, drawn, 0.0)


@triton.jit
def _band_1(sh, d_sh, x, y, z, d_color, drawn, inside, further):
    dy = _add_back(sh, d_sh, y * -C1, d_color, 1, drawn, inside, further) * -C1
    dz = _add_back(sh, d_sh, z * C1, d_color, 2, drawn, inside, further) * C1
    dx = _add_back(sh, d_sh, x * -C1, d_color, 3, drawn, inside, further) * -C1
    return dx, dy, dz


@triton.jit
def _band_2(sh, d_sh, x, y, z, d_color, drawn, inside, further):
    xx, yy, zz = x * x, y * y, z * z
    dx, dy, dz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    p = _add_back(sh, d_sh, x * C20 * y, d_color, 4, drawn, inside, further) * C20
    dx, dy = dx + p * y, dy + p * x
    p = _add_back(sh, d_sh, y * C21 * z, d_color, 5, drawn, inside, further) * C21
    dy, dz = dy + p * z, dz + p * y
    p = _add_back(sh, d_sh, (2 * zz - xx - yy) * C22, d_color, 6, drawn, inside, further) * C22
    dx, dy, dz = dx - 2 * p * x, dy - 2 * p * y, dz + 4 * p * z
    p = _add_back(sh, d_sh, x * C23 * z, d_color, 7, drawn, inside, further) * C23
    dx, dz = dx + p * z, dz + p * x
    p = _add_back(sh, d_sh, (xx - yy) * C24, d_color, 8, drawn, inside, further) * C24
    dx, dy = dx + 2 * p * x, dy - 2 * p * y
    return dx, dy, dz


@triton.jit
def _band_3(sh, d_sh, x, y, z, d_color, drawn, inside, further):
    xx, yy, zz = x * x, y * y, z * z
    dx, dy, dz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    p = _add_back(sh, d_sh, y * C30 * (3 * xx - yy), d_color, 9, drawn, inside, further) * C30
    dx, dy = dx + 6 * p * x * y, dy + 3 * p * (xx - yy)
    p = _add_back(sh, d_sh, x * C31 * y * z, d_color, 10, drawn, inside, further) * C31
    dx, dy, dz = dx + p * y * z, dy + p * x * z, dz + p * x * y
    p = _add_back(sh, d_sh, y * C32 * (4 * zz - xx - yy), d_color, 11, drawn, inside, further) * C32
    dx, dy, dz = dx - 2 * p * x * y, dy + p * (4 * zz - xx - 3 * yy), dz + 8 * p * y * z
    p = _add_back(sh, d_sh, z * C33 * (2 * zz - 3 * xx - 3 * yy), d_color, 12, drawn, inside, further) * C33
    dx, dy, dz = dx - 6 * p * x * z, dy - 6 * p * y * z, dz + p * (6 * zz - 3 * xx - 3 * yy)
    p = _add_back(sh, d_sh, x * C34 * (4 * zz - xx - yy), d_color, 13, drawn, inside, further) * C34
    dx, dy, dz = dx + p * (4 * zz - 3 * xx - yy), dy - 2 * p * x * y, dz + 8 * p * x * z
    p = _add_back(sh, d_sh, z * C35 * (xx - yy), d_color, 14, drawn, inside, further) * C35
    dx, dy, dz = dx + 2 * p * x * z, dy - 2 * p * y * z, dz + p * (xx - yy)
    p = _add_back(sh, d_sh, x * C36 * (xx - 3 * yy), d_color, 15, drawn, inside, further) * C36
    dx, dy = dx + 3 * p * (xx - yy), dy - 6 * p * x * y
    return dx, dy, dz


@triton.jit
def _band_4(sh, d_sh, x, y, z, d_color, drawn, inside, further):
    xx, yy, zz = x * x, y * y, z * z
    dx, dy, dz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    p = _add_back(sh, d_sh, x * C40 * y * (xx - yy), d_color, 16, drawn, inside, further) * C40
    dx, dy = dx + p * y * (3 * xx - yy), dy + p * x * (xx - 3 * yy)
    p = _add_back(sh, d_sh, y * C41 * z * (3 * xx - yy), d_color, 17, drawn, inside, further) * C41
    dx, dy, dz = dx + 6 * p * x * y * z, dy + 3 * p * z * (xx - yy), dz + p * y * (3 * xx - yy)
    p = _add_back(sh, d_sh, x * C42 * y * (7 * zz - 1), d_color, 18, drawn, inside, further) * C42
    dx, dy, dz = dx + p * y * (7 * zz - 1), dy + p * x * (7 * zz - 1), dz + 14 * p * x * y * z
    p = _add_back(sh, d_sh, y * C43 * z * (7 * zz - 3), d_color, 19, drawn, inside, further) * C43
    dy, dz = dy + p * z * (7 * zz - 3), dz + p * y * (21 * zz - 3)
    p = _add_back(sh, d_sh, (zz * (35 * zz - 30) + 3) * C44, d_color, 20, drawn, inside, further) * C44
    dz += p * z * (140 * zz - 60)
    p = _add_back(sh, d_sh, x * C45 * z * (7 * zz - 3), d_color, 21, drawn, inside, further) * C45
    dx, dz = dx + p * z * (7 * zz - 3), dz + p * x * (21 * zz - 3)
    p = _add_back(sh, d_sh, (xx - yy) * C46 * (7 * zz - 1), d_color, 22, drawn, inside, further) * C46
    dx, dy, dz = dx + 2 * p * x * (7 * zz - 1), dy - 2 * p * y * (7 * zz - 1), dz + 14 * p * z * (xx - yy)
    p = _add_back(sh, d_sh, x * C47 * z * (xx - 3 * yy), d_color, 23, drawn, inside, further) * C47
    dx, dy, dz = dx + 3 * p * z * (xx - yy), dy - 6 * p * x * y * z, dz + p * x * (xx - 3 * yy)
    p = _add_back(sh, d_sh, (xx * (xx - 3 * yy) - yy * (3 * xx - yy)) * C48, d_color, 24, drawn, inside, further) * C48
    dx, dy = dx + 4 * p * x * (xx - 3 * yy), dy + 4 * p * y * (yy - 3 * xx)
    return dx, dy, dz


@triton.jit
def color_back(sh, d_sh, x, y, z, degree, d_color, drawn, inside, further, DEGREE: tl.constexpr):
    """Backward pass of `color`: add the gradients of the coefficients `inside` at the pointers `d_sh` [B], return those of x, y, z.

    d_color is 0 where not `drawn`.
    """
    _add_back(sh, d_sh, tl.zeros_like(x) + C0, d_color, 0, drawn, inside, further)
    dx, dy, dz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    if DEGREE >= 1:
        d_color, drawn = tl.where(degree >= 1, d_color, 0.0), at_most(degree, drawn, 1)
        px, py, pz = _band_1(sh, d_sh, x, y, z, d_color, drawn, inside, further)
        dx, dy, dz = dx + px, dy + py, dz + pz
    if DEGREE >= 2:
        d_color, drawn = tl.where(degree >= 2, d_color, 0.0), at_most(degree, drawn, 2)
        px, py, pz = _band_2(sh, d_sh, x, y, z, d_color, drawn, inside, further)
        dx, dy, dz = dx + px, dy + py, dz + pz
    if DEGREE >= 3:
        d_color, drawn = tl.where(degree >= 3, d_color, 0.0), at_most(degree, drawn, 3)
        px, py, pz = _band_3(sh, d_sh, x, y, z, d_color, drawn, inside, further)
        dx, dy, dz = dx + px, dy + py, dz + pz
    if DEGREE >= 4:
        d_color, drawn = tl.where(degree >= 4, d_color, 0.0), at_most(degree, drawn, 4)
        px, py, pz = _band_4(sh, d_sh, x, y, z, d_color, drawn, inside, further)
        dx, dy, dz = dx + px, dy + py, dz + pz
    return dx, dy, dz
