"""r(x) for zoom-in: an image made larger, by a registered name or by the file of a super-resolution network."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from torch import Tensor

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.super_resolution import SUFFIXES, Network
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.registry import Registry

Upsampler = Callable[[Tensor, tuple[int, int]], Tensor]

UPSAMPLERS = Registry(
    "mipmap_plugin.upsamplers",
    {name: f"mipmap_plugin.adaptation.target.upsamplers:{name}" for name in ("bicubic", "lanczos")},
)


def register_upsampler(name: str, target: Any, *, replace: bool = False) -> None:
    """Add a function `(image [H, W, 3], size) -> [size[0], size[1], 3]` under `name`, or `"package.module:function"`."""
    UPSAMPLERS.add(name, target, replace=replace)


def find_upsampler(name: str) -> Upsampler:
    """The upsampler of a registered name, or the network in a file. Raises SettingsError, CheckpointError and PluginError."""
    check_upsampler(name)
    return UPSAMPLERS.get(name) if name in UPSAMPLERS.names() else Network(name)


def check_upsampler(name: str) -> None:
    """Raise SettingsError where there is none of this name, without loading any."""
    known = UPSAMPLERS.names()
    if name in known:
        return
    if not name.endswith(SUFFIXES):
        raise SettingsError(f"there is no upsampler {name!r}; known are {', '.join(known)}, or give the file of a network ({', '.join(SUFFIXES)})")
    if not Path(name).is_file():
        raise SettingsError(f"there is no upsampler file {name}; check the path")


def bicubic(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Keys' cubic, a = -0.5, as Pillow's."""
    return resize(image, size, "pil-bicubic")


def lanczos(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Three lobes, as Pillow's."""
    return resize(image, size, "lanczos")
