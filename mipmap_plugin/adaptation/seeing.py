"""Which cameras see anything: of a capture that was cut down to one object, most do not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from mipmap_plugin.adaptation.shown import showing
from mipmap_plugin.adaptation.warn import warn
from mipmap_plugin.camera import Camera

# How many splats are looked for in each round. Nearly every camera sees one of the first round's; only the others look for more.
SAMPLES = 1 << 8, 1 << 14, 1 << 16

# A camera counts as seeing a splat whose center lies in a frame this many times as large as its picture: splats reach into a picture from beside it.
LARGER = 2


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
    warn(f"{blind} of {len(cameras)} cameras {'sees' if blind == 1 else 'see'} no splat, or hardly any, and {'is' if blind == 1 else 'are'} left out")
    return kept


def _larger(camera: Camera) -> Camera:
    width, height = LARGER * camera.width, LARGER * camera.height
    return replace(camera, width=width, height=height, cx=camera.cx + (width - camera.width) / 2, cy=camera.cy + (height - camera.height) / 2)
