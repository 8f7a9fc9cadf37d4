"""What the kernels are given: records that numba reads as tuples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# What of a splat its alpha is: what lies at the pixel's center, or its mean over the pixel's square, or over the pixel's window.
SEEN_AT_CENTER, SEEN_IN_PIXEL, SEEN_IN_WINDOW = range(3)


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
    least_light: float  # the share of its opacity that compensation leaves at least; 1: there is no compensation
    seen: int  # one of the three above
    sh_degree: int
    max_color: float
    color_steps: tuple  # three; 0: not rounded
    radial: bool  # whether the order is that of distances
    frame: float  # half pictures
    min_alpha: float
    cut: float  # the weight at which a splat is cut off; 0: none is
    faded: float  # the weight at which a splat has faded to 0; 0: none does
    culls: bool  # whether any of the next four is asked for
    min_variance: float  # px²
    boxed: bool
    min_contribution: float  # px²
    least_spread: float  # px²
    max_variance: float  # px²; infinite: splats may be of any size
    felt: bool  # whether splats that are culled are listed, for their gradient


class Splats(NamedTuple):
    """The tensors of `Gaussians`, or their gradients, as contiguous float32 arrays. [0, ...] for the shape that is not used."""

    means: np.ndarray  # [N, 3]
    quats: np.ndarray  # [N, 4] or [0, 4]
    scales: np.ndarray  # [N, 3] or [0, 3]
    opacities: np.ndarray  # [N]
    sh: np.ndarray  # [N, K, 3]
    covariances: np.ndarray  # [N, 3, 3] or [0, 3, 3]


class Limits(NamedTuple):
    """What ends a splat and a pixel."""

    max_alpha: float
    min_transmittance: float
    picture_step: float  # 0: pictures are not rounded


class Lists(NamedTuple):
    """Which splats each tile shows; front to back once `sorting.sort` was there, which the compositing calls."""

    starts: np.ndarray  # [tiles + 1] where each tile's members begin
    members: np.ndarray  # [pairs] splats
    slots: np.ndarray  # [pairs] where each keeps what it has to do with this tile, splat after splat
    splats: np.ndarray  # [pairs] whose slot each is


class Frame(NamedTuple):
    """What the backward pass needs to know of an image."""

    background: np.ndarray  # [3]
    through: np.ndarray  # [H, W] transmittance in the end
    stops: np.ndarray  # [H, W] place in the tile's list at which the pixel was finished
