"""Images that are needed again, in 16 bits and under a bound on memory."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor

# Steps from 0 to 1: a multiple of 255, so that 8-bit images are exact, and as fine as leaves room for the overshoots of resizing (-2..2 in
# all). The rounding error is at 95 dB, so that an image at 65 dB from the truth is still measured right to 0.01 dB.
STEPS = 255 * 64

# The largest number that is stored.
MOST = torch.iinfo(torch.int16).max

# The fraction of a GPU's memory that stored images leave free.
LEFT_FREE = 0.5


def in_16_bits(image: Tensor) -> Tensor:
    """An image of -2..2 as it is stored."""
    return (image * STEPS).round_().clamp_(-MOST, MOST).to(torch.int16)


def from_16_bits(stored: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """An image that was stored, of floats or whole numbers."""
    return stored / _steps(dtype)


@cache
def _steps(dtype: torch.dtype) -> Tensor:
    """STEPS on the processor: a number to a GPU, whose type the image gets in the same operation."""
    return torch.tensor(STEPS, dtype=dtype)


class ImageStore:
    """Images by key, each made once while there is room. What is returned does not depend on whether there was."""

    def __init__(self, limit: int, like: Tensor) -> None:
        """`limit`: bytes of all images together; further ones are made again each time. `like`: has the device and dtype of the images."""
        self._limit, self._like = limit, like
        self._images: dict[Hashable, Tensor] = {}
        self._bytes = 0

    def __call__(self, key: Hashable, make: Callable[[], Tensor]) -> Tensor:
        """Return the image `key`, [H, W, 3] in -2..2, or else make it."""
        stored = self._images.get(key)
        if stored is None:
            stored = in_16_bits(make())
            self._keep([key], stored[None])
        return from_16_bits(stored.to(self._like.device, non_blocking=True), self._like.dtype)

    def of_one_size(self, keys: Sequence[Hashable], make: Callable[[list[int]], Tensor]) -> Tensor:
        """Return several images, [V, H, W, 3]; those that are not there are made together, by the numbers of their keys."""
        stored = {number: self._images[key] for number, key in enumerate(keys) if key in self._images}
        if new := [number for number in range(len(keys)) if number not in stored]:
            made = in_16_bits(make(new))
            self._keep([keys[number] for number in new], made)
            stored |= dict(zip(new, made.unbind(), strict=True))
        all_of_them = torch.stack([stored[number].to(self._like.device, non_blocking=True) for number in range(len(keys))])
        return from_16_bits(all_of_them, self._like.dtype)

    def __contains__(self, key: Hashable) -> bool:
        return key in self._images

    def _keep(self, keys: Sequence[Hashable], images: Tensor) -> None:
        """Keep as many of the images [V, H, W, 3] as there is room for."""
        if room := (self._limit - self._bytes) // images[0].nbytes:
            kept = moved_off_full_gpu(images[:room])
            self._images |= dict(zip(keys, kept.unbind(), strict=False))
            self._bytes += kept.nbytes

    def keep_only(self, is_needed: Callable[[Any], bool]) -> None:
        """Make room by forgetting every image whose key is not needed."""
        kept = {key: image for key, image in self._images.items() if is_needed(key)}
        # Of images that were made together, one alone would keep the memory of all.
        self._images = {key: image.clone() if image.untyped_storage().nbytes() > image.nbytes else image for key, image in kept.items()}
        self._bytes = sum(image.nbytes for image in self._images.values())


def moved_off_full_gpu(image: Tensor) -> Tensor:
    """Return `image`, or, if half of its GPU's memory is used, a copy in pinned host memory, which the GPU reads without blocking the host."""
    if image.device.type != "cuda":
        return image
    free, total = torch.cuda.mem_get_info(image.device)
    return image if free > LEFT_FREE * total else image.cpu().pin_memory()
