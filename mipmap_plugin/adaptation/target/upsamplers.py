"""r(x) for zoom-in: an image is made larger, by an upsampler's registered name or the file of a super-resolution network."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.super_resolution import SUFFIXES, Network
from mipmap_plugin.errors import MipmapPluginError, PluginError, SettingsError
from mipmap_plugin.registry import Registry

Upsampler = Callable[[Tensor, tuple[int, int]], Tensor]

UPSAMPLERS = Registry(
    "mipmap_plugin.upsamplers",
    {name: f"mipmap_plugin.adaptation.target.upsamplers:{name}" for name in ("bicubic", "lanczos")},
)


def register_upsampler(name: str, target: Any, *, replace: bool = False) -> None:
    """Register a function `(image [H, W, 3], size) -> [size[0], size[1], 3]`, or `"package.module:function"`, under `name`."""
    UPSAMPLERS.add(name, target, replace=replace)


def find_upsampler(name: str) -> Upsampler:
    """Return the upsampler of a registered name, or the network in a file. Raises SettingsError, CheckpointError and PluginError.

    One that was registered raises PluginError where it fails, or returns anything else than an image of that size.
    """
    check_upsampler(name)
    return partial(_enlarged, name, UPSAMPLERS.get(name)) if name in UPSAMPLERS.names() else Network(name)


def _enlarged(name: str, upsampler: Upsampler, image: Tensor, size: tuple[int, int]) -> Tensor:
    """What an upsampler makes of an image, [size[0], size[1], 3]. Raises PluginError."""
    try:
        made = upsampler(image, size)
    except (MipmapPluginError, MemoryError):
        raise
    except Exception as error:  # third-party code may fail in any way
        raise PluginError(f"upsampler {name!r} failed: {type(error).__name__}: {error}") from error
    if not isinstance(made, Tensor) or tuple(made.shape) != (*size, 3) or not made.isfinite().all():
        got = f"{list(made.shape)}, {'' if made.isfinite().all() else 'not '}all finite" if isinstance(made, Tensor) else f"a {type(made).__name__}"
        raise PluginError(f"upsampler {name!r} has to return an image {[*size, 3]} of finite numbers; it returned {got}")
    return made


def check_upsampler(name: str) -> None:
    """Raise SettingsError if there is no upsampler of this name, without loading any."""
    known = UPSAMPLERS.names()
    if name in known:
        return
    if not name.endswith(SUFFIXES):
        raise SettingsError(f"there is no upsampler {name!r}; choose from {', '.join(known)}, or give the file of a network ({', '.join(SUFFIXES)})")
    if not Path(name).is_file():
        raise SettingsError(f"there is no upsampler file {name}; check the path")


def bicubic(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize with Keys' cubic, a = -0.5, as Pillow does."""
    return resize(image, size, "pil-bicubic")


def lanczos(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize with Lanczos' kernel of three lobes, as Pillow does."""
    return resize(image, size, "lanczos")
