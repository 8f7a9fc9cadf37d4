"""Which views show something of a scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import compress

import torch
from torch import Tensor

from mipmap_plugin.adaptation.parallel import in_batches
from mipmap_plugin.adaptation.warn import warn
from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import some_of
from mipmap_plugin.progress import announced

# How many splats are looked for in each round. Nearly every camera sees one of the first round's; only the others look for more.
SAMPLES = 1 << 8, 1 << 14, 1 << 16

# A camera counts as seeing a splat whose center lies in a frame this many times as large as its picture: splats reach into a picture from beside it.
LARGER = 2

# What is said where most cameras see nothing.
MISFIT = "; so many may be of another scene, or in other coordinates: give those of this one, unless it was cut down"


@announced("examining views")
def showing(views: Sequence[Camera], means: Tensor, near: float) -> list[Camera]:
    """The views that show one of the `means` [N, 3], farther than the near plane (world units)."""
    shown = [inside.any(1) for inside in inside_pictures(views, means, near)]
    return list(compress(views, torch.cat(shown).tolist())) if shown else []


def inside_pictures(views: Sequence[Camera], means: Tensor, near: float) -> Iterator[Tensor]:
    """Which `means` [N, 3] lie in the pictures of views, farther than the near plane: [V, N] bool for each batch of views."""
    for view in in_batches(views, means):
        yield view.in_picture(view.to_camera(means.detach()), near)


def telling(validation: Sequence[Camera], means: Tensor, near: float) -> list[Camera]:
    """The views for validation that show something of splats at `means` [N, 3], or all if fewer than two do: one steers, and one chooses."""
    shown = showing(validation, means, near)
    return shown if len(shown) > 1 else list(validation)


def seeing(cameras: Sequence[Camera], means: Tensor, near: float) -> list[Camera]:
    """The cameras that see something of splats at `means` [N, 3], with a warning of how many do not. `near`: the near plane, in world units.

    Only some of many splats are looked for, so that a camera which sees a few of a million counts as blind. If none of the training's cameras
    sees anything, all cameras are kept.
    """
    if len(cameras) < 2:
        return list(cameras)
    frames = {_larger(camera): camera for camera in cameras}  # of cameras that saw nothing so far
    for most in SAMPLES:
        for frame in showing(list(frames), means[:: max(1, len(means) // most)], near):
            del frames[frame]
    others = set(frames.values())
    kept = [camera for camera in cameras if camera not in others]
    blind = len(cameras) - len(kept)
    if not blind or not any(camera.split == "train" for camera in kept):
        return list(cameras)
    told = f"{some_of(blind, len(cameras), 'camera', 'see')} no splat, or hardly any, and {'is' if blind == 1 else 'are'} left out"
    warn(told + (MISFIT if blind > len(cameras) / 2 else ""))
    return kept


def _larger(camera: Camera) -> Camera:
    width, height = LARGER * camera.width, LARGER * camera.height
    return replace(camera, width=width, height=height, cx=camera.cx + (width - camera.width) / 2, cy=camera.cy + (height - camera.height) / 2)
