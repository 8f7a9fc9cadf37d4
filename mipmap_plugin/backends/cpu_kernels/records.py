"""The arguments of kernels: named tuples, which numba reads as tuples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Where a splat's alpha comes from: its value at the pixel's center, its mean over the pixel's square, or its mean over the pixel's window.
AT_CENTER, OVER_PIXEL, OVER_WINDOW = range(3)


class Flags(NamedTuple):
    """What most images do without: True, or None where it is off. The type of None is known when a kernel is compiled, which so leaves out
    what is off, and takes half the time."""

    covariances: bool | None  # splats have these in place of quaternions and scales
    integrated: bool | None  # over pixels or windows
    reshaped: bool | None  # culled, stretched or shrunk
    faded: bool | None  # they fade to 0 before they end
    fourth: bool | None  # their colors have harmonics of degree 4
    third: bool | None  # they have those of degree 3, and no others: 16 bands, as many as a vector has lanes


class View(NamedTuple):
    """A camera, and the effects and settings that kernels need. Numbers only, no arrays."""

    rotation: tuple[tuple[float, ...], ...]  # 3 rows of 3, world to camera
    translation: tuple[float, ...]  # 3
    eye: tuple[float, ...]  # 3, in world coordinates
    fx: float
    fy: float
    cx: float
    cy: float
    left: float  # bounds of x/z and y/z, beyond which the Jacobian is frozen
    right: float
    top: float
    bottom: float
    width: int
    height: int
    near_plane: float
    eps2d: float
    min_compensation: float  # the least factor that compensation applies to an opacity; 1: no compensation
    sampling: int  # AT_CENTER, OVER_PIXEL or OVER_WINDOW
    sh_degree: int
    max_color: float
    color_steps: tuple[float, ...]  # 3; 0: not rounded
    radial: bool  # whether splats are sorted by distance from the eye instead of depth
    max_offset: float  # a splat is drawn if its center lies within this many half pictures of the middle, along x and y
    min_alpha: float
    w_cut: float  # the weight at which splats are cut off; 0: not cut off
    w_end: float  # the weight at which splats have faded to 0; 0: no fading
    culls: bool  # whether one of min_variance, min_contribution and least_spread is set
    min_variance: float  # px²
    boxed: bool
    min_contribution: float  # px²
    rooted: bool
    least_spread: float  # px²
    level_below: float  # px²
    max_variance: float  # px²; infinite: no limit
    lists_culled: bool  # whether the lists of tiles contain culled splats, for their gradient


class SplatArrays(NamedTuple):
    """The tensors of `Gaussians`, or their gradients, as contiguous float32 arrays; [0, ...] for a shape that is not in use."""

    means: np.ndarray  # [N, 3]
    quats: np.ndarray  # [N, 4] or [0, 4]
    scales: np.ndarray  # [N, 3] or [0, 3]
    opacities: np.ndarray  # [N]
    sh: np.ndarray  # [N, K, 3]
    covariances: np.ndarray  # [N, 3, 3] or [0, 3, 3]


class Limits(NamedTuple):
    """Cut-offs of alpha and of transmittance, and the rounding of pictures."""

    max_alpha: float
    min_transmittance: float
    picture_step: float  # 0: pictures are not rounded


class Lists(NamedTuple):
    """Each tile's list of splats; front to back after `sorting.sort`, which compositing calls."""

    starts: np.ndarray  # [tiles + 1] where each tile's list begins
    members: np.ndarray  # [pairs] the splats of each list
    slots: np.ndarray  # [pairs] the slot of each member: its row of the gradient table, where the pairs of a splat are adjacent
    patches: np.ndarray  # [pairs] the patches of its tile that each member touches, a bit for each; from `patches.find_patches`
    firsts: np.ndarray  # [N + 1] each splat's first slot
    splats: np.ndarray  # [pairs] the splat of each slot


class Frame(NamedTuple):
    """What the backward pass needs of an image."""

    background: np.ndarray  # [3]
    transmittance: np.ndarray  # [H, W] behind all splats
    stops: np.ndarray  # [H, W] the position in the tile's list at which the pixel stopped
