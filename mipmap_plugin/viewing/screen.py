"""The camera of a screen: from a pose, to another zoom, and what of a scene it shows."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mipmap_plugin.adaptation.views.pixel_size import pixel_size
from mipmap_plugin.camera import Camera, evenly, viewmat_of
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.limits import MAX_SCALE, MIN_SCALE
from mipmap_plugin.splatting.rotations import quaternions, rotations

# Vertical fields of view, radians: below the first nothing is left of a scene, above the second splats are stretched beyond recognition.
LEAST_FOV, LARGEST_FOV = math.radians(0.5), math.radians(110)

# Iterations to find the pose of a zoom: the zoom is that of the median splat in the picture, and another picture has another median.
ROUNDS = 8

# Medians are computed of at most so many splats, and so many views, evenly spread.
MOST_SPLATS, MOST_VIEWS = 100_000, 16


@dataclass(frozen=True)
class Pose:
    """Where an eye is, which way it looks, and the point that it turns around."""

    wxyz: tuple[float, ...]  # camera to world, OpenCV's axes
    position: tuple[float, ...]  # world units
    look_at: tuple[float, ...]  # world units, in front of the eye
    fov: float  # vertical, radians

    def camera(self, width: int, height: int) -> Camera:
        """The pinhole of an image of `width` x `height` px. Raises SettingsError for a field of view that no pinhole has."""
        if not 0 < self.fov < math.pi:
            raise SettingsError(f"the field of view has to be above 0 and below 180 degrees, got {math.degrees(self.fov):g}; load the page again")
        rotation = rotations(torch.tensor([self.wxyz], dtype=torch.float64))[0]
        viewmat = viewmat_of(rotation, torch.tensor(self.position, dtype=torch.float64))
        focal = height / (2 * math.tan(self.fov / 2))
        return Camera(width, height, focal, focal, width / 2, height / 2, viewmat, "screen")


@dataclass(frozen=True)
class OnScreen:
    """What of a scene a camera shows."""

    splats: int  # whose centers lie inside the picture
    zoom: float  # how finely the median of these splats is sampled, relative to a typical view of the training; 1 if there are none
    depth: float  # of that median, world units; 1 if there are none


class Sampling:
    """How finely the training sampled each splat of the base, so that a screen can be compared with it."""

    def __init__(self, means: Tensor, views: Sequence[Camera], near: float) -> None:
        """`means`: [N, 3] world units; `views`: of the training, at its scale; `near`: the near plane, in world units."""
        self._near = near
        self.means = means.detach()[:: max(1, -(-len(means) // MOST_SPLATS))]
        self._pixels = pixel_size(self.means, views)  # in the closest view, so that most views sample more coarsely
        typical = torch.tensor([self.of(view).zoom for view in evenly(views, MOST_VIEWS)]).median()
        self._pixels = self._pixels / typical
        self._focal = float(torch.tensor([math.sqrt(view.fx * view.fy) for view in evenly(views, MOST_VIEWS)]).median())  # px

    def with_lens(self, camera: Camera) -> Camera:
        """The camera with the `zoom` of its lens: its focal length over a typical one of the training, without the distance."""
        return replace(camera, zoom=math.sqrt(camera.fx * camera.fy) / self._focal)

    def of(self, camera: Camera) -> OnScreen:
        """The zoom of a camera, and the depth of what it shows; the splats are counted among those looked at (`inside` counts all)."""
        seen = inside(self.means, camera, self._near)
        if not seen.any():
            return OnScreen(0, 1.0, 1.0)
        depths = camera.to_camera(self.means[seen])[:, 2]
        zooms = self._pixels[seen] * (camera.fx * camera.fy) ** 0.5 / depths
        return OnScreen(int(seen.sum()), min(max(float(zooms.median()), MIN_SCALE), MAX_SCALE), float(depths.median()))


def inside(means: Tensor, camera: Camera, near: float) -> Tensor:
    """Which centers [N, 3] lie inside the picture, farther than the near plane (world units), [N] bool."""
    return camera.in_picture(camera.to_camera(means), near)


def pose_of(camera: Camera, depth: float) -> Pose:
    """The pose of a camera that turns around the point in the middle of its picture at this depth (world units)."""
    rotation, center = camera.viewmat[:3, :3].T, camera.center
    fov = 2 * math.atan(camera.height / (2 * camera.fy))
    return Pose(tuple(quaternions(rotation[None])[0].tolist()), tuple(center.tolist()), tuple((center + depth * rotation[:, 2]).tolist()), fov)


def up_of(views: Sequence[Camera]) -> tuple[float, ...]:
    """The mean of what the views have upwards, a unit vector in world axes."""
    mean = -torch.stack([view.viewmat[1, :3] for view in views]).mean(0)
    return tuple((mean / mean.norm()).tolist()) if mean.norm() > 0 else (0.0, 0.0, 1.0)


def zoomed(pose: Pose, zoom: float, sampling: Sampling, size: tuple[int, int], change: Callable[[Pose, float], Pose]) -> Pose:
    """The pose whose picture of `size` (height, width) px has this zoom, as nearly as can be; `change`: `by_distance` or `by_lens`."""
    for _ in range(ROUNDS):
        now = sampling.of(pose.camera(size[1], size[0]))
        if now.splats == 0:
            break
        pose = change(pose, zoom / now.zoom)
    return pose


def by_lens(pose: Pose, factor: float) -> Pose:
    """The pose with `factor` times the focal length, as far as the field of view may go."""
    fov = 2 * math.atan(math.tan(pose.fov / 2) / factor)
    return replace(pose, fov=min(max(fov, LEAST_FOV), LARGEST_FOV))


def by_distance(pose: Pose, factor: float) -> Pose:
    """The pose at the `factor`-th part of its distance from `look_at`."""
    moved = tuple(target + (eye - target) / factor for eye, target in zip(pose.position, pose.look_at, strict=True))
    return replace(pose, position=moved)
