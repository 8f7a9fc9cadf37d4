"""Photographs to compare with: in 8 bits where that loses nothing, and under a limit of memory, beyond which they are read again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.scenes import Scene

# Bytes that one evaluation keeps: 700 photographs of half a megapixel, or 200 of 1.6.
MOST_BYTES = 2**30


def kept_photographs(
    scene: Scene, cameras: Sequence[Camera], background: tuple[float, float, float], most_bytes: int = MOST_BYTES
) -> list[Callable[[], Tensor]]:
    """For each camera a function that returns its photograph, bit for bit as `Scene.image` does.

    All are read at once, so that a damaged file is found before anything is measured. Raises SceneError.
    """
    found: list[Callable[[], Tensor]] = []
    for camera in cameras:
        kept = packed(scene.image(camera, background))
        fits = kept.nbytes <= most_bytes
        most_bytes -= kept.nbytes * fits
        found.append(partial(unpacked, kept) if fits else partial(scene.image, camera, background))
    return found


def packed(image: Tensor) -> Tensor:
    """An image [H, W, 3] in 0..1 as uint8 if these are its levels exactly, else (16 bits, undistorted) as it is."""
    levels = image.mul(255).round_().to(torch.uint8)
    return levels if torch.equal(unpacked(levels), image) else image


def unpacked(kept: Tensor) -> Tensor:
    """What was `packed`, float32."""
    return kept.to(torch.float32).div_(255) if kept.dtype == torch.uint8 else kept
