"""Real spherical harmonics up to degree 4 and their derivative, for 16 directions at a time."""

# numba redefines calls and operators.
# mypy: ignore-errors

from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.blocks import get, put
from mipmap_plugin.backends.cpu_kernels.lanes import broadcast
from mipmap_plugin.splatting.harmonics import C0, C1, C2, C3, C4

MAX_BANDS = 25


@inner
def basis(direction, degree, fourth, bands):
    """Write the (degree + 1)² basis functions at unit vectors, 16 float32 per band. fourth: as of `records.Flags`."""
    x, y, z = direction
    xx, yy, zz = x * x, y * y, z * z
    put(bands, 0, broadcast(C0))
    if degree > 0:
        put(bands, 1, -C1 * y)
        put(bands, 2, C1 * z)
        put(bands, 3, -C1 * x)
    if degree > 1:
        put(bands, 4, C2[0] * x * y)
        put(bands, 5, C2[1] * y * z)
        put(bands, 6, C2[2] * (2 * zz - xx - yy))
        put(bands, 7, C2[3] * x * z)
        put(bands, 8, C2[4] * (xx - yy))
    if degree > 2:
        put(bands, 9, C3[0] * y * (3 * xx - yy))
        put(bands, 10, C3[1] * x * y * z)
        put(bands, 11, C3[2] * y * (4 * zz - xx - yy))
        put(bands, 12, C3[3] * z * (2 * zz - 3 * xx - 3 * yy))
        put(bands, 13, C3[4] * x * (4 * zz - xx - yy))
        put(bands, 14, C3[5] * z * (xx - yy))
        put(bands, 15, C3[6] * x * (xx - 3 * yy))
    if fourth is not None:
        put(bands, 16, C4[0] * x * y * (xx - yy))
        put(bands, 17, C4[1] * y * z * (3 * xx - yy))
        put(bands, 18, C4[2] * x * y * (7 * zz - 1))
        put(bands, 19, C4[3] * y * z * (7 * zz - 3))
        put(bands, 20, C4[4] * (zz * (35 * zz - 30) + 3))
        put(bands, 21, C4[5] * x * z * (7 * zz - 3))
        put(bands, 22, C4[6] * (xx - yy) * (7 * zz - 1))
        put(bands, 23, C4[7] * x * z * (xx - 3 * yy))
        put(bands, 24, C4[8] * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)))


@inner
def grad_direction(direction, degree, fourth, w):
    """The gradient of Σ w_j · basis_j with respect to the directions, before these are normalized."""
    x, y, z = direction
    xx, yy, zz = x * x, y * y, z * z
    gx = gy = gz = broadcast(0)
    if degree > 0:
        gx, gy, gz = -C1 * get(w, 3), -C1 * get(w, 1), C1 * get(w, 2)
    if degree > 1:
        v4, v5, v6, v7, v8 = C2[0] * get(w, 4), C2[1] * get(w, 5), C2[2] * get(w, 6), C2[3] * get(w, 7), C2[4] * get(w, 8)
        gx = gx + v4 * y - 2 * v6 * x + v7 * z + 2 * v8 * x
        gy = gy + v4 * x + v5 * z - 2 * v6 * y - 2 * v8 * y
        gz = gz + v5 * y + 4 * v6 * z + v7 * x
    if degree > 2:
        v9, v10, v11, v12 = C3[0] * get(w, 9), C3[1] * get(w, 10), C3[2] * get(w, 11), C3[3] * get(w, 12)
        v13, v14, v15 = C3[4] * get(w, 13), C3[5] * get(w, 14), C3[6] * get(w, 15)
        gx = gx + 6 * v9 * x * y + v10 * y * z - 2 * v11 * x * y - 6 * v12 * x * z
        gx = gx + v13 * (4 * zz - 3 * xx - yy) + 2 * v14 * x * z + 3 * v15 * (xx - yy)
        gy = gy + 3 * v9 * (xx - yy) + v10 * x * z + v11 * (4 * zz - xx - 3 * yy) - 6 * v12 * y * z
        gy = gy - (2 * v13 * x * y + 2 * v14 * y * z + 6 * v15 * x * y)
        gz = gz + v10 * x * y + 8 * v11 * y * z + v12 * (6 * zz - 3 * xx - 3 * yy) + 8 * v13 * x * z + v14 * (xx - yy)
    if fourth is not None:
        v16, v17, v18, v19, v20 = C4[0] * get(w, 16), C4[1] * get(w, 17), C4[2] * get(w, 18), C4[3] * get(w, 19), C4[4] * get(w, 20)
        v21, v22, v23, v24 = C4[5] * get(w, 21), C4[6] * get(w, 22), C4[7] * get(w, 23), C4[8] * get(w, 24)
        gx = gx + v16 * y * (3 * xx - yy) + 6 * v17 * x * y * z + v18 * y * (7 * zz - 1) + v21 * z * (7 * zz - 3)
        gx = gx + 2 * v22 * x * (7 * zz - 1) + 3 * v23 * z * (xx - yy) + 4 * v24 * x * (xx - 3 * yy)
        gy = gy + v16 * x * (xx - 3 * yy) + 3 * v17 * z * (xx - yy) + v18 * x * (7 * zz - 1) + v19 * z * (7 * zz - 3)
        gy = gy + -2 * v22 * y * (7 * zz - 1) - 6 * v23 * x * y * z + 4 * v24 * y * (yy - 3 * xx)
        gz = gz + v17 * y * (3 * xx - yy) + 14 * v18 * x * y * z + v19 * y * (21 * zz - 3) + v20 * z * (140 * zz - 60)
        gz = gz + v21 * x * (21 * zz - 3) + 14 * v22 * z * (xx - yy) + v23 * x * (xx - 3 * yy)
    return gx, gy, gz
