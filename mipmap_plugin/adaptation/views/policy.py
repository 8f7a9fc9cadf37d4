"""Which views are adapted to. All follows from one seed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from mipmap_plugin.adaptation.views.viewpoints import Viewpoints
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import SettingsError, plural
from mipmap_plugin.scenes.orbits import ORBIT_FOV
from mipmap_plugin.scenes.photographed import GOLDEN
from mipmap_plugin.scenes.trajectories import jittered, with_company

# A checkpoint without cameras does not say at what resolution it was trained: this many px across 50 degrees is NeRF-Synthetic's.
ORBIT_PIXELS = 800
ORBIT_VIEWS = 50


def extent(views: Sequence[Camera]) -> float:
    """The extent of a scene in world units: 1.1 times the largest distance of a camera from the cameras' mean (INRIA's `spatial_lr_scale`).

    It is 1 for a single camera, or for several in one place, which tell nothing about the scene's size.
    """
    centers = torch.stack([view.center for view in views])
    radius = 1.1 * float((centers - centers.mean(0)).norm(dim=1).max())
    return radius if radius > 0 else 1.0


def choose_views(cameras: Sequence[Camera], viewpoints: Viewpoints, config: AdaptConfig) -> tuple[list[Camera], str]:
    """Return the base-scale cameras to adapt to, and a description of them. `viewpoints`: where generated views are.

    Raises SettingsError when the policy finds no cameras.
    """
    generator = torch.Generator().manual_seed(config.seed)
    if config.views == "orbit" or not cameras:
        pixels = math.ceil(2 * math.tan(ORBIT_FOV / 2) * cameras[0].fx) if cameras else ORBIT_PIXELS  # the cameras' own focal length
        orbit, count = viewpoints.orbit, config.extra_views or ORBIT_VIEWS
        views = viewpoints.views((pixels, pixels), count, generator)
        reason = "as requested" if cameras else "the checkpoint came without cameras"
        told = f" {orbit.told()}," if orbit.up or orbit.seen else ""
        pixels = max(min(view.size) for view in views)
        return views, f"{plural(len(views), 'view')} of a generated orbit{told} at {pixels} px ({reason})"
    if config.views == "given":
        return list(cameras), f"the {plural(len(cameras), 'given view')}"
    split = "test" if config.views == "test" else "train"
    views = [camera for camera in cameras if camera.split == split]
    if not views:
        none = f"there are no {split} views among the {plural(len(cameras), 'camera')}"
        raise SettingsError(f"{none}; give cameras that have some, or use the view policy 'given'")
    if config.views == "jittered":
        extra = jittered(with_company(views, viewpoints.orbit), config.extra_views, generator)
        return views + extra, f"{plural(len(views), 'train view')} and {len(extra)} around {'it' if len(views) == 1 else 'them'}"
    return views, f"the {plural(len(views), f'{split} view')}"


def over_band(views: Sequence[Camera], config: AdaptConfig) -> list[Camera]:
    """The views of the base scale, each at one multiple of it out of the settings' band, evenly spread over the band's logarithm."""
    low, high = config.band
    if low == high == 1:
        return list(views)
    return [view.zoomed(low * (high / low) ** ((number + 0.5) * GOLDEN % 1)) for number, view in enumerate(views)]
