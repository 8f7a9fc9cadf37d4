"""Vectors and rotations, one splat per lane, as tuples of numbers; loads and stores of a few numbers per row."""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin.splatting import rotations

LARGEST = tl.constexpr(3.4e38)
LEAST_QUATERNION = tl.constexpr(rotations.LEAST_QUATERNION)


@triton.jit
def finite(a):
    return tl.abs(a) <= LARGEST  # False for NaN


@triton.jit
def load3(rows, mask):
    return tl.load(rows, mask, 0.0), tl.load(rows + 1, mask, 0.0), tl.load(rows + 2, mask, 0.0)


@triton.jit
def store3(rows, a, b, c, mask):
    tl.store(rows, a, mask)
    tl.store(rows + 1, b, mask)
    tl.store(rows + 2, c, mask)


@triton.jit
def add(rows, a, mask, further):
    """Store `a` at the pointers `rows`, or add it to what is there where `further`."""
    tl.store(rows, tl.load(rows, mask & further, 0.0) + a, mask)


@triton.jit
def add3(rows, a, b, c, mask, further):
    """As `add`, for three numbers side by side."""
    add(rows, a, mask, further)
    add(rows + 1, b, mask, further)
    add(rows + 2, c, mask, further)


@triton.jit
def dot(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@triton.jit
def cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@triton.jit
def unit(w, x, y, z):
    """A normalized quaternion, and 1 / norm; zeros for a zero quaternion, whose rotation is the identity."""
    largest = tl.maximum(tl.maximum(tl.abs(w), tl.abs(x)), tl.maximum(tl.abs(y), tl.abs(z)))
    zero = largest < LEAST_QUATERNION
    per = tl.where(zero, 0.0, 1 / tl.where(zero, 1.0, largest))  # without this factor the squares may overflow or underflow
    w, x, y, z = w * per, x * per, y * per, z * per
    scale = tl.rsqrt(tl.where(zero, 1.0, w * w + x * x + y * y + z * z))
    return w * scale, x * scale, y * scale, z * scale, scale * per


@triton.jit
def rotation_columns(w, x, y, z):
    """The three columns of a unit quaternion's rotation matrix."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


@triton.jit
def rotation_columns_back(w, x, y, z, a, b, c):
    """Gradients of w, x, y, z from those of the columns a, b, c."""
    dw = 2 * (x * (b[2] - c[1]) + y * (c[0] - a[2]) + z * (a[1] - b[0]))
    dx = 2 * (w * (b[2] - c[1]) + y * (a[1] + b[0]) + z * (a[2] + c[0]) - 2 * x * (b[1] + c[2]))
    dy = 2 * (w * (c[0] - a[2]) + x * (a[1] + b[0]) + z * (b[2] + c[1]) - 2 * y * (a[0] + c[2]))
    dz = 2 * (w * (a[1] - b[0]) + x * (a[2] + c[0]) + y * (b[2] + c[1]) - 2 * z * (a[0] + b[1]))
    return dw, dx, dy, dz
