"""Images that took long to make, kept on disk from one run to the next."""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from mipmap_plugin.errors import CheckpointError, OutputError, OutputExists
from mipmap_plugin.formats.torch_file import load_torch, save_torch

VARIABLE = "MIPMAP_PLUGIN_CACHE"


def cache_folder() -> Path:
    """Where they lie: what MIPMAP_PLUGIN_CACHE says, else `mipmap_plugin` in the user's cache folder. It may be deleted at any time."""
    if folder := os.environ.get(VARIABLE):
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mipmap_plugin"


def fingerprint(image: Tensor, *facts: object) -> str:
    """A name that no other image and facts have."""
    digest = hashlib.sha256(repr((facts, tuple(image.shape), image.dtype)).encode())
    digest.update(image.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def cached(name: str, make: Callable[[], Tensor]) -> Tensor:
    """The image kept as `name`, or else what `make` returns; in half precision both times, which is a tenth of an 8-bit step.

    A damaged file is made anew. A folder that cannot be written to costs the image the next time, and a warning now.
    """
    file = cache_folder() / name[:2] / f"{name}.pt"
    if (kept := _kept(file)) is not None:
        return kept.float()
    image = make().detach().to("cpu", torch.float16)
    try:
        save_torch(file, image, overwrite=True)
    except (OutputError, OutputExists) as error:
        warnings.warn(f"the image is made again next time, for {error} (the variable {VARIABLE} names another folder)", stacklevel=2)
    return image.float()


def _kept(file: Path) -> Tensor | None:
    if not file.is_file():
        return None
    try:
        kept = load_torch(file)
    except CheckpointError:
        return None
    return kept if isinstance(kept, Tensor) and kept.dim() == 3 and kept.is_floating_point() else None
