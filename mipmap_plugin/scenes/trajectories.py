"""Generated views: around the given ones, or around the scene where none are given. Each needs no photograph."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import NEAR_PLANE
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.gaussians import Gaussians

ORBIT_FOV = math.radians(50)  # across the shorter side: neither wide nor tele
ORBIT_ELEVATIONS = (math.radians(10), math.radians(50))  # above the horizon, where people hold cameras

# The share of the splats that an orbit frames; the farthest tenth are mostly floaters and background.
FRAMED = 0.9

# How much flatter along y than along z a scene must be before y is taken for its vertical.
FLATTER = 0.8

# A generated view lies on the way from a camera to one of its nearest few, or this share of the way beyond either end. With 4
# neighbors and nothing beyond, views fill the gaps between cameras so poorly that 0.8 dB are lost on lego's test views at x1/8.
NEIGHBORS = 16
BEYOND = 0.25

# Sine of the angle below which two lines of sight say nothing about where they meet.
PARALLEL = 1e-6

# Cameras that are turned farther apart see different things, and nobody looked where halfway between them is.
SAME_DIRECTION = math.radians(60)


def orbit(
    means: Tensor | Gaussians, size: tuple[int, int], count: int, generator: torch.Generator, up: Sequence[float] | None = None
) -> list[Camera]:
    """`count` views of `size` (height, width) px around the scene, for a checkpoint that came without cameras.

    All look at the median of `means` [N, 3] from a distance that frames nine tenths of them; azimuths are even from a
    random start, elevations random. `up` (world axes) is `guess_up` unless given. It suits objects: where the cameras
    of an unbounded scene stood cannot be known from its splats. Raises SettingsError without splats or views.
    """
    means = means.means if isinstance(means, Gaussians) else means
    means = means.detach().to("cpu", torch.float64)
    means = means[means.isfinite().all(dim=1)]
    if len(means) == 0 or count < 1:
        raise SettingsError(f"an orbit needs splats and views, but got {len(means)} finite splats and {count} views")
    center = means.median(dim=0).values
    vertical = guess_up(means) if up is None else torch.tensor(up, dtype=torch.float64)
    radius = _quantile((means - center).norm(dim=1), FRAMED).item()
    distance = max(radius / math.sin(ORBIT_FOV / 2), radius + 2 * NEAR_PLANE)  # a small scene must not fall before the near plane
    directions = _sky_directions(vertical / vertical.norm(), count, generator)
    return [_looking_at(center, center + distance * each, vertical, size, f"orbit_{i:04d}") for i, each in enumerate(directions)]


def guess_up(means: Tensor) -> Tensor:
    """[3] the likely vertical of the splats at `means` [N, 3]: +z (Blender, nerfstudio), or -y (COLMAP) for a scene clearly flatter along y.

    Scenes are wider than they are high. On flowers of mip-NeRF 360 (-y) and on lego and chair (+z) it is right.
    """
    spread = _quantile(means, FRAMED) - _quantile(means, 1 - FRAMED)
    return means.new_tensor((0.0, -1.0, 0.0) if spread[1] < FLATTER * spread[2] else (0.0, 0.0, 1.0))


def jittered(cameras: Sequence[Camera], count: int, generator: torch.Generator, amount: float = 0.05) -> list[Camera]:
    """`count` views from where the scene was seen, looking the way it was looked at, for training.

    Each takes the lens, size and time of one of `cameras` (all in turn, in random order) and lies at a random point on
    the way to a near camera that looks the same way, or a little before or behind it (`BEYOND`): centers on the arc around what
    both look at, rotations on an arc. Then its center moves by `amount` of the distance between the two, and it turns by `amount`
    of its field of view, one standard deviation each. Raises SettingsError without cameras.
    """
    if not cameras or count < 0 or amount < 0:
        raise SettingsError(f"jittered views need cameras, but got {len(cameras)} cameras, count={count} and amount={amount}")
    centers = torch.stack([camera.center for camera in cameras])
    rotations = torch.stack([camera.viewmat[:3, :3].T for camera in cameras])  # camera to world
    order = torch.cat([torch.randperm(len(cameras), generator=generator) for _ in range(count // len(cameras) + 1)])
    views = []
    for number, index in enumerate(order[:count].tolist()):
        camera, other = cameras[index], _neighbor(index, centers, rotations, generator)
        along = (1 + 2 * BEYOND) * torch.rand((), generator=generator, dtype=torch.float64) - BEYOND
        shift, turn = torch.randn((2, 3), generator=generator, dtype=torch.float64) * amount / math.sqrt(3)  # over three axes
        way = rotation_vector(rotations[index].T @ rotations[other])
        fov = 2 * math.atan(camera.width / (2 * camera.fx))
        rotation = rotations[index] @ rotation_matrix(way * along) @ rotation_matrix(turn * fov)
        gap = (centers[other] - centers[index]).norm()
        center = _on_arc(centers[[index, other]], rotations[[index, other], :, 2], along) + shift * gap
        views.append(replace(camera, viewmat=_viewmat(rotation, center), name=f"jittered_{number:04d}", split="train"))
    return views


def rotation_vector(rotation: Tensor) -> Tensor:
    """[3] axis times angle (radians, below pi) of a rotation [3, 3]; the logarithm."""
    angle = _angles(rotation)
    skew = rotation - rotation.T
    return torch.stack([skew[2, 1], skew[0, 2], skew[1, 0]]) / (2 * torch.sinc(angle / math.pi))


def rotation_matrix(vector: Tensor) -> Tensor:
    """[3, 3] the rotation by |vector| radians around `vector` [3]; the exponential."""
    x, y, z = vector.tolist()
    return torch.linalg.matrix_exp(vector.new_tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]]))


def _on_arc(centers: Tensor, forwards: Tensor, along: Tensor) -> Tensor:
    """[3] the point `along` (0..1, or beyond) the way between two eyes [2, 3] that look `forwards` [2, 3], around what both look at.

    That is where their lines of sight come closest. Where they do not meet in front of both, the way is straight.
    """
    gap = centers[1] - centers[0]
    sights = torch.stack([forwards[0], -forwards[1]], dim=1)
    depths = torch.linalg.lstsq(sights, gap[:, None], driver="gelsd").solution[:, 0]
    parallel = torch.linalg.cross(forwards[0], forwards[1]).norm() < PARALLEL
    if parallel or depths.min() <= 0:
        return centers[0] + gap * along
    focus = (centers + forwards * depths[:, None]).mean(0)
    radii = (centers - focus).norm(dim=1)
    start, end = (centers - focus) / radii[:, None]
    axis = torch.linalg.cross(start, end)
    angle = torch.atan2(axis.norm(), start @ end)
    turn = rotation_matrix(axis / axis.norm().clamp_min(PARALLEL) * angle * along)
    return focus + turn @ start * radii[0] ** (1 - along) * radii[1] ** along


def _neighbor(index: int, centers: Tensor, rotations: Tensor, generator: torch.Generator) -> int:
    """One of the nearest cameras that look the same way as number `index`; itself where none does."""
    angles = _angles(rotations[index].T @ rotations)
    distances = (centers - centers[index]).norm(dim=1)
    distances[angles > SAME_DIRECTION] = math.inf
    distances[index] = math.inf
    nearest = distances.argsort()[:NEIGHBORS]
    nearest = nearest[distances[nearest].isfinite()]
    if len(nearest) == 0:
        return index
    return int(nearest[torch.randint(len(nearest), (), generator=generator)])


def _angles(rotations: Tensor) -> Tensor:
    """[...] radians that rotations [..., 3, 3] turn by."""
    trace = rotations.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.acos(((trace - 1) / 2).clamp(-1, 1))


def _sky_directions(up: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """[count, 3] unit vectors at even azimuths and random elevations over the horizon whose normal is `up` (unit)."""
    east = torch.linalg.cross(up, torch.eye(3, dtype=up.dtype)[up.abs().argmin()])
    east = east / east.norm()
    north = torch.linalg.cross(up, east)
    start, chance = torch.rand((), generator=generator, dtype=up.dtype), torch.rand(count, 1, generator=generator, dtype=up.dtype)
    azimuth = (torch.arange(count, dtype=up.dtype)[:, None] / count + start) * 2 * math.pi
    low, high = ORBIT_ELEVATIONS
    elevation = low + (high - low) * chance
    return elevation.cos() * (azimuth.cos() * east + azimuth.sin() * north) + elevation.sin() * up


def _looking_at(target: Tensor, eye: Tensor, up: Tensor, size: tuple[int, int], name: str) -> Camera:
    """A camera at `eye` that looks at `target` with `up` upwards; columns of its rotation are right, down, forward."""
    forward = (target - eye) / (target - eye).norm()
    right = torch.linalg.cross(forward, up)
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
    height, width = size
    focal = min(size) / (2 * math.tan(ORBIT_FOV / 2))
    return Camera(width, height, focal, focal, width / 2, height / 2, _viewmat(rotation, eye), name)


def _viewmat(rotation: Tensor, center: Tensor) -> Tensor:
    """World to camera [4, 4] from a camera-to-world rotation and the eye."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ center
    return viewmat


def _quantile(values: Tensor, share: float) -> Tensor:
    """The value below which `share` of the first dimension lies. torch.quantile refuses more than 16 million values."""
    return values.kthvalue(max(1, round(share * len(values))), dim=0).values
