"""A splat's covariance on the image, from its axes or its covariance in the world, and the gradients. Formulas: `splatting/projection.py`."""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin.backends.triton_kernels.vectors import add, add3, cross, dot, load3, rotation_columns, rotation_columns_back, unit


@triton.jit
def load_quat(rows, mask):
    return tl.load(rows, mask, 0.0), tl.load(rows + 1, mask, 0.0), tl.load(rows + 2, mask, 0.0), tl.load(rows + 3, mask, 0.0)


@triton.jit
def from_axes(quat, scale, t, r):
    """xx, xy, yy and the determinant, without cancellation. t and r: image axes x and y, px per world unit."""
    w, x, y, z, _ = unit(quat[0], quat[1], quat[2], quat[3])
    a, b, c = rotation_columns(w, x, y, z)
    f0, f1, f2 = scale[0] * dot(*t, *a), scale[1] * dot(*t, *b), scale[2] * dot(*t, *c)
    g0, g1, g2 = scale[0] * dot(*r, *a), scale[1] * dot(*r, *b), scale[2] * dot(*r, *c)
    n0, n1, n2 = cross(f0, f1, f2, g0, g1, g2)
    return dot(f0, f1, f2, f0, f1, f2), dot(f0, f1, f2, g0, g1, g2), dot(g0, g1, g2, g0, g1, g2), dot(n0, n1, n2, n0, n1, n2)


@triton.jit
def times(rows, mask, v):
    """Σ v and Σᵀ v for the matrices Σ [3, 3] at `rows`."""
    a, b, c = load3(rows, mask), load3(rows + 3, mask), load3(rows + 6, mask)
    forth = dot(*a, *v), dot(*b, *v), dot(*c, *v)
    back = a[0] * v[0] + b[0] * v[1] + c[0] * v[2], a[1] * v[0] + b[1] * v[1] + c[1] * v[2], a[2] * v[0] + b[2] * v[1] + c[2] * v[2]
    return forth, back


@triton.jit
def from_covariance(rows, mask, t, r):
    """As `from_axes`, for covariances [3, 3] at `rows`."""
    forth_t, _ = times(rows, mask, t)
    forth_r, _ = times(rows, mask, r)
    xx, xy, yy = dot(*t, *forth_t), dot(*t, *forth_r), dot(*r, *forth_r)
    return xx, xy, yy, tl.maximum(xx * yy - xy * xy, 0.0)


@triton.jit
def from_axes_back(quat, scale, t, r, d_xx, d_xy, d_yy, d_det, d_quats, d_scales, inside, further, RAW: tl.constexpr):
    """Add the gradients of quaternions and scales, or of the scales' logarithms; return those of the image axes."""
    w, x, y, z, inverse = unit(quat[0], quat[1], quat[2], quat[3])
    a, b, c = rotation_columns(w, x, y, z)
    ta, tb, tc = dot(*t, *a), dot(*t, *b), dot(*t, *c)
    ra, rb, rc = dot(*r, *a), dot(*r, *b), dot(*r, *c)
    f0, f1, f2, g0, g1, g2 = scale[0] * ta, scale[1] * tb, scale[2] * tc, scale[0] * ra, scale[1] * rb, scale[2] * rc
    n0, n1, n2 = cross(f0, f1, f2, g0, g1, g2)
    p0, p1, p2 = cross(g0, g1, g2, n0, n1, n2)
    q0, q1, q2 = cross(n0, n1, n2, f0, f1, f2)
    df0, df1, df2 = 2 * (d_xx * f0 + d_det * p0) + d_xy * g0, 2 * (d_xx * f1 + d_det * p1) + d_xy * g1, 2 * (d_xx * f2 + d_det * p2) + d_xy * g2
    dg0, dg1, dg2 = 2 * (d_yy * g0 + d_det * q0) + d_xy * f0, 2 * (d_yy * g1 + d_det * q1) + d_xy * f1, 2 * (d_yy * g2 + d_det * q2) + d_xy * f2
    d0, d1, d2 = df0 * ta + dg0 * ra, df1 * tb + dg1 * rb, df2 * tc + dg2 * rc
    if RAW:
        d0, d1, d2 = d0 * scale[0], d1 * scale[1], d2 * scale[2]
    add3(d_scales, d0, d1, d2, inside, further)
    df0, df1, df2, dg0, dg1, dg2 = scale[0] * df0, scale[1] * df1, scale[2] * df2, scale[0] * dg0, scale[1] * dg1, scale[2] * dg2
    da = df0 * t[0] + dg0 * r[0], df0 * t[1] + dg0 * r[1], df0 * t[2] + dg0 * r[2]
    db = df1 * t[0] + dg1 * r[0], df1 * t[1] + dg1 * r[1], df1 * t[2] + dg1 * r[2]
    dc = df2 * t[0] + dg2 * r[0], df2 * t[1] + dg2 * r[1], df2 * t[2] + dg2 * r[2]
    dw, dx, dy, dz = rotation_columns_back(w, x, y, z, da, db, dc)
    along = w * dw + x * dx + y * dy + z * dz  # removed below: the norm of a quaternion does not matter
    add(d_quats, inverse * (dw - w * along), inside, further)
    add3(d_quats + 1, inverse * (dx - x * along), inverse * (dy - y * along), inverse * (dz - z * along), inside, further)
    dt = df0 * a[0] + df1 * b[0] + df2 * c[0], df0 * a[1] + df1 * b[1] + df2 * c[1], df0 * a[2] + df1 * b[2] + df2 * c[2]
    dr = dg0 * a[0] + dg1 * b[0] + dg2 * c[0], dg0 * a[1] + dg1 * b[1] + dg2 * c[1], dg0 * a[2] + dg1 * b[2] + dg2 * c[2]
    return dt, dr


@triton.jit
def from_covariance_back(rows, mask, t, r, d_xx, d_xy, d_yy, d_det, d_rows, inside, further):
    """Add the gradient of the covariances; return those of the image axes."""
    forth_t, back_t = times(rows, mask, t)
    forth_r, back_r = times(rows, mask, r)
    xx, xy, yy = dot(*t, *forth_t), dot(*t, *forth_r), dot(*r, *forth_r)
    d_det = tl.where(xx * yy - xy * xy < 0, 0.0, d_det)
    d_xx, d_xy, d_yy = d_xx + d_det * yy, d_xy - 2 * d_det * xy, d_yy + d_det * xx
    for i in tl.static_range(3):
        left, right = d_xx * t[i], d_yy * r[i]
        across = d_xy * t[i]
        add3(d_rows + 3 * i, left * t[0] + across * r[0] + right * r[0], left * t[1] + across * r[1] + right * r[1],
             left * t[2] + across * r[2] + right * r[2], inside, further)  # fmt: skip
    dt = (d_xx * (forth_t[0] + back_t[0]) + d_xy * forth_r[0], d_xx * (forth_t[1] + back_t[1]) + d_xy * forth_r[1],
          d_xx * (forth_t[2] + back_t[2]) + d_xy * forth_r[2])  # fmt: skip
    dr = (d_yy * (forth_r[0] + back_r[0]) + d_xy * back_t[0], d_yy * (forth_r[1] + back_r[1]) + d_xy * back_t[1],
          d_yy * (forth_r[2] + back_r[2]) + d_xy * back_t[2])  # fmt: skip
    return dt, dr
