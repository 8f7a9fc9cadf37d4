"""A cache on disk for images that take long to make."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from mipmap_plugin.errors import CheckpointError, OutputError, OutputExists, warn
from mipmap_plugin.formats.torch_file import load_torch, save_torch

VARIABLE = "MIPMAP_PLUGIN_CACHE"


def cache_folder() -> Path:
    """The folder of the cache: MIPMAP_PLUGIN_CACHE, or else `mipmap_plugin` in the user's cache folder. It may be deleted at any time."""
    if folder := os.environ.get(VARIABLE):
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mipmap_plugin"


def fingerprint(image: Tensor, *facts: object) -> str:
    """A hash of an image and of `facts`, to name a file in the cache."""
    digest = hashlib.sha256(repr((facts, tuple(image.shape), image.dtype)).encode())
    digest.update(image.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def cached(name: str, make: Callable[[], Tensor]) -> Tensor:
    """Return the image cached as `name`, or else make and cache it; in both cases in half precision, accurate to a tenth of an 8-bit step.

    A damaged file is replaced. If the folder cannot be written to, the image is not cached, with a warning.
    """
    file = cache_folder() / name[:2] / f"{name}.pt"
    if (stored := _load(file)) is not None:
        return stored.float()
    image = make().detach().to("cpu", torch.float16)
    try:
        save_torch(file, image, overwrite=True)
    except (OutputError, OutputExists) as error:
        warn(f"the image is not cached: {error}; set the variable {VARIABLE} to another folder")
    return image.float()


def _load(file: Path) -> Tensor | None:
    if not file.is_file():
        return None
    try:
        image = load_torch(file)
    except CheckpointError:
        return None
    return image if isinstance(image, Tensor) and image.dim() == 3 and image.is_floating_point() else None
