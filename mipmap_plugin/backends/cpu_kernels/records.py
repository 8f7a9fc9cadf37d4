"""What the kernels are given: records that numba reads as tuples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class View(NamedTuple):
    """A camera and the effects that concern a splat. Numbers alone, no arrays."""

    rotation: tuple  # three rows of three, world to camera
    translation: tuple  # three
    eye: tuple  # three, world
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
