"""Photographs to compare with: in 8 bits where that loses nothing, and under a limit of memory, beyond which they are read again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.scenes import Scene

# Bytes that one evaluation keeps: 700 photographs of half a megapixel, or 200 of 1.6.
MOST_BYTES = 2**30


class Photographs:
    """The photographs of a scene on one background."""

    def __init__(self, scene: Scene, background: tuple[float, float, float], most_bytes: int = MOST_BYTES) -> None:
        self._scene, self._background, self._left = scene, background, most_bytes

    def of(self, camera: Camera) -> Callable[[], Tensor]:
        """What returns the photograph of `camera` as `Scene.image` does, bit for bit, whenever it is asked.

        It is read at once, so that a damaged file is found before anything is measured. Raises SceneError.
        """
        kept = packed(self._scene.image(camera, self._background))
        if kept.nbytes > self._left:
            return lambda: self._scene.image(camera, self._background)
        self._left -= kept.nbytes
        return lambda: unpacked(kept)


def digest_of_image(image: Tensor) -> str:
    """A hash of an image, hexadecimal."""
    return hashlib.sha256(image.cpu().numpy().tobytes()).hexdigest()


def packed(image: Tensor) -> Tensor:
    """An image [H, W, 3] in 0..1 as uint8 if these are its levels exactly, else (16 bits, undistorted) as it is."""
    levels = image.mul(255).round_().to(torch.uint8)
    return levels if torch.equal(unpacked(levels), image) else image


def unpacked(kept: Tensor) -> Tensor:
    """What was `packed`, float32."""
    return kept.to(torch.float32).div_(255) if kept.dtype == torch.uint8 else kept
