"""Real spherical harmonics up to degree 4 and their derivative, one direction at a time."""

from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.harmonics import C0, C1, C2, C3, C4

MAX_BANDS = 25


@inner
def basis(direction, degree, out):
    """Write the (degree + 1)² basis functions of a unit vector."""
    x, y, z = direction
    xx, yy, zz = x * x, y * y, z * z
    out[0] = C0
    if degree > 0:
        out[1], out[2], out[3] = -C1 * y, C1 * z, -C1 * x
    if degree > 1:
        out[4], out[5], out[6] = C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy)
        out[7], out[8] = C2[3] * x * z, C2[4] * (xx - yy)
    if degree > 2:
        out[9], out[10], out[11] = C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, C3[2] * y * (4 * zz - xx - yy)
        out[12], out[13] = C3[3] * z * (2 * zz - 3 * xx - 3 * yy), C3[4] * x * (4 * zz - xx - yy)
        out[14], out[15] = C3[5] * z * (xx - yy), C3[6] * x * (xx - 3 * yy)
    if degree > 3:
        out[16], out[17], out[18] = C4[0] * x * y * (xx - yy), C4[1] * y * z * (3 * xx - yy), C4[2] * x * y * (7 * zz - 1)
        out[19], out[20], out[21] = C4[3] * y * z * (7 * zz - 3), C4[4] * (zz * (35 * zz - 30) + 3), C4[5] * x * z * (7 * zz - 3)
        out[22], out[23] = C4[6] * (xx - yy) * (7 * zz - 1), C4[7] * x * z * (xx - 3 * yy)
        out[24] = C4[8] * (xx * (xx - 3 * yy) - yy * (3 * xx - yy))


@inner
def slope(direction, degree, w):
    """The gradient of Σ w_j · basis_j with respect to the direction, before it is normalized."""
    x, y, z = direction
    xx, yy, zz = x * x, y * y, z * z
    gx, gy, gz = 0.0, 0.0, 0.0
    if degree > 0:
        gx, gy, gz = -C1 * w[3], -C1 * w[1], C1 * w[2]
    if degree > 1:
        v4, v5, v6, v7, v8 = C2[0] * w[4], C2[1] * w[5], C2[2] * w[6], C2[3] * w[7], C2[4] * w[8]
        gx += v4 * y - 2 * v6 * x + v7 * z + 2 * v8 * x
        gy += v4 * x + v5 * z - 2 * v6 * y - 2 * v8 * y
        gz += v5 * y + 4 * v6 * z + v7 * x
    if degree > 2:
        v9, v10, v11, v12 = C3[0] * w[9], C3[1] * w[10], C3[2] * w[11], C3[3] * w[12]
        v13, v14, v15 = C3[4] * w[13], C3[5] * w[14], C3[6] * w[15]
        gx += 6 * v9 * x * y + v10 * y * z - 2 * v11 * x * y - 6 * v12 * x * z
        gx += v13 * (4 * zz - 3 * xx - yy) + 2 * v14 * x * z + 3 * v15 * (xx - yy)
        gy += 3 * v9 * (xx - yy) + v10 * x * z + v11 * (4 * zz - xx - 3 * yy) - 6 * v12 * y * z
        gy -= 2 * v13 * x * y + 2 * v14 * y * z + 6 * v15 * x * y
        gz += v10 * x * y + 8 * v11 * y * z + v12 * (6 * zz - 3 * xx - 3 * yy) + 8 * v13 * x * z + v14 * (xx - yy)
    if degree > 3:
        v16, v17, v18, v19, v20 = C4[0] * w[16], C4[1] * w[17], C4[2] * w[18], C4[3] * w[19], C4[4] * w[20]
        v21, v22, v23, v24 = C4[5] * w[21], C4[6] * w[22], C4[7] * w[23], C4[8] * w[24]
        gx += v16 * y * (3 * xx - yy) + 6 * v17 * x * y * z + v18 * y * (7 * zz - 1) + v21 * z * (7 * zz - 3)
        gx += 2 * v22 * x * (7 * zz - 1) + 3 * v23 * z * (xx - yy) + 4 * v24 * x * (xx - 3 * yy)
        gy += v16 * x * (xx - 3 * yy) + 3 * v17 * z * (xx - yy) + v18 * x * (7 * zz - 1) + v19 * z * (7 * zz - 3)
        gy += -2 * v22 * y * (7 * zz - 1) - 6 * v23 * x * y * z + 4 * v24 * y * (yy - 3 * xx)
        gz += v17 * y * (3 * xx - yy) + 14 * v18 * x * y * z + v19 * y * (21 * zz - 3) + v20 * z * (140 * zz - 60)
        gz += v21 * x * (21 * zz - 3) + 14 * v22 * z * (xx - yy) + v23 * x * (xx - 3 * yy)
    return gx, gy, gz
