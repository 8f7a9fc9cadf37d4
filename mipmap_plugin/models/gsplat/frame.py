"""The coordinate frame of a gsplat checkpoint: that of the scene, normalized by a similarity that the trainer computes but does not save.

The formulas are those of gsplat's examples/datasets/normalize.py (Apache-2.0).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SceneError

# Rotations by 180 degrees that principal axes leave undetermined: the signs of eigenvectors differ between machines, and later versions
# of gsplat turn upside-down scenes over.
HALF_TURNS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))

# Numbers of points and splats that are compared: enough to distinguish the half turns.
POINTS, SPLATS = 1000, 20_000

# Largest median distance from points to splats, in a frame whose cameras are about 1 from the center; above it, it is another scene.
NEAR_ENOUGH = 0.2


def normalized_frame(cameras: Sequence[Camera], points: Tensor, means: Tensor) -> Tensor:
    """The similarity [4, 4] float64 from the world of the scene to that of the checkpoint.

    Computed from all cameras of the COLMAP scene and its points [P, 3]. Among the undetermined half turns, the one that brings the
    points closest to the splats at `means` [N, 3] is chosen. Raises SceneError if they are too far apart.
    """
    points, means = points.double(), means.detach().to("cpu", torch.float64)
    upright = _around_cameras(cameras)
    aligned = _principal_axes(_moved(points, upright)) @ upright
    frames = [torch.diag(torch.tensor([*turn, 1], dtype=torch.float64)) @ aligned for turn in HALF_TURNS]
    gaps = [_median_gap(_moved(points, frame), means) for frame in frames]
    if min(gaps) > NEAR_ENOUGH:
        raise SceneError("the points of the COLMAP scene do not match the splats; give the scene that gsplat was trained on")
    return frames[gaps.index(min(gaps))]


def _around_cameras(cameras: Sequence[Camera]) -> Tensor:
    """[4, 4]: up is -y, the point that the cameras look at is the origin, and their median distance from it is 1."""
    to_world = torch.stack([camera.viewmat[:3, :3].T for camera in cameras])
    centers = torch.stack([camera.center for camera in cameras])
    up = -to_world[:, :, 1].mean(0)
    align = _turn_to_minus_y(up / up.norm())
    forward, centers = (align @ to_world)[:, :, 2], centers @ align.T
    nearest = centers - (forward * centers).sum(1, keepdim=True) * forward
    shift = -nearest.quantile(0.5, dim=0)
    size = 1 / (centers + shift).norm(dim=1).quantile(0.5)
    return _affine(size * align, size * shift)


def _turn_to_minus_y(up: Tensor) -> Tensor:
    """The rotation [3, 3] that takes the unit vector `up` to -y, by Rodrigues' formula."""
    down = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    cosine = down @ up
    if cosine <= -1:
        return torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))  # gsplat has a reflection here, which is no valid camera transform
    x, y, z = torch.linalg.cross(up, down).tolist()
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + skew + skew @ skew / (1 + cosine)


def _principal_axes(points: Tensor) -> Tensor:
    """[4, 4]: the median of the points is the origin, their widest spread is along x, the next along y."""
    center = points.quantile(0.5, dim=0)
    vectors = torch.linalg.eigh(torch.cov((points - center).T)).eigenvectors.flip(1)
    if torch.linalg.det(vectors) < 0:
        vectors = vectors * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    return _affine(vectors.T, -vectors.T @ center)


def _affine(linear: Tensor, shift: Tensor) -> Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = linear, shift
    return matrix


def _moved(points: Tensor, frame: Tensor) -> Tensor:
    return points @ frame[:3, :3].T + frame[:3, 3]


def _median_gap(points: Tensor, means: Tensor) -> float:
    some, splats = points[:: -(-len(points) // POINTS)], means[:: -(-len(means) // SPLATS)]
    return float(torch.cdist(some, splats).amin(1).median())
