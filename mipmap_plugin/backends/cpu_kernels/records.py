"""What the kernels pass to each other: records that numba reads, and the columns of the splat table."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]


class View(NamedTuple):
    """A camera and the effects that concern a splat. Numbers alone, no arrays."""

    rotation: Matrix  # world to camera
    translation: Vector
    eye: Vector  # world
    fx: float
    fy: float
    cx: float
    cy: float
    left: float  # least x/z
    right: float  # most x/z
    top: float  # least y/z
    bottom: float  # most y/z at which the Jacobian is not yet frozen
    width: int
    height: int
    near: float
    eps2d: float
    antialiased: bool
    sh_degree: int


class Splats(NamedTuple):
    """The tensors of `Gaussians`, or their gradients, as contiguous float32 arrays. [0, ...] for the shape that is not used."""

    means: np.ndarray  # [N, 3]
    quats: np.ndarray  # [N, 4] or [0, 4]
    scales: np.ndarray  # [N, 3] or [0, 3]
    opacities: np.ndarray  # [N]
    sh: np.ndarray  # [N, K, 3]
    covariances: np.ndarray  # [N, 3, 3] or [0, 3, 3]


# Columns of the splat table [N, COLUMNS] float32. With dy = y - Y and u = x - X - SHEAR·dy:
# log2 alpha = PEAK - FALL_Y·dy² - FALL_X·u², a sum of squares, accurate for needles too.
X, Y, SHEAR, FALL_Y, FALL_X, PEAK = range(6)
RED, GREEN, BLUE = 6, 7, 8
REACH_Y = 9  # px from Y to the last row where alpha reaches 1/255
TIP = 10  # px from Y to the row where the splat reaches furthest right; as far the other way, furthest left
SPREAD = 11  # 1 / FALL_X
COLUMNS = 16  # one cache line

# Columns of the gradient table, one row per (splat, tile): sums over the tile's pixels of s = alpha · dLoss/dalpha times 1, u, dy,
# u², u·dy and dy²; then dLoss/dcolor.
SUM, SUM_U, SUM_Y, SUM_UU, SUM_UY, SUM_YY = range(6)
PULLS = 9

# The published constants (diff-gaussian-rasterization, forward.cu).
MIN_ALPHA = 1 / 255  # below one 8-bit step a splat cannot change a displayed pixel
LOG_MIN_ALPHA = float(np.log2(MIN_ALPHA))
MAX_ALPHA = 0.99  # keeps 1 - alpha away from 0, where the gradient of everything behind the splat vanishes
MIN_TRANSMITTANCE = 1e-4  # a pixel this opaque is finished

# The least share of its opacity that compensation leaves to a splat (dr_aa, gsplat 1.6).
MIN_COMPENSATION = 0.005

# Rows and columns this close to a splat's edge are visited too: rounding must not lose a pixel that passes the alpha test.
SLACK = 0.01  # px
