"""r(x) for zoom-in: an image is made larger, by an upsampler's registered name or the file of a super-resolution network."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.super_resolution import SUFFIXES, Network
from mipmap_plugin.errors import PluginError, SettingsError, type_of
from mipmap_plugin.formats.atomic import sha256
from mipmap_plugin.plugin_errors import is_third_party, naming
from mipmap_plugin.registry import Registry

Upsampler = Callable[[Tensor, tuple[int, int]], Tensor]

# Colors are 0..1, and what sharpens goes a little beyond. Farther beyond, an image is one of another range, such as 0..255.
LOWEST, HIGHEST = -1.0, 2.0

UPSAMPLERS = Registry("mipmap_plugin.upsamplers", {name: f"mipmap_plugin.adaptation.target.upsamplers:{name}" for name in ("bicubic", "lanczos")})

# Where the file of a network lies here that settings name by its path on another machine, by that name.
_PLACED: ContextVar[tuple[str, Path] | None] = ContextVar("placed", default=None)


def register_upsampler(name: str, target: Any, *, replace: bool = False) -> None:
    """Register a function `(image [H, W, 3], size) -> [size[0], size[1], 3]`, or `"package.module:function"`, under `name`. Raises SettingsError."""
    UPSAMPLERS.add(name, target, replace=replace)


def find_upsampler(name: str) -> Upsampler:
    """Return the upsampler of a registered name, or the network in a file. Raises SettingsError, CheckpointError and PluginError.

    One that was registered raises PluginError where it is no function, and later where it fails, or returns anything else than an image of that size.
    """
    check_upsampler(name)
    if name not in UPSAMPLERS.names():
        return Network(_file(name))
    upsampler = UPSAMPLERS.get(name)
    if not callable(upsampler):
        raise PluginError(f"upsampler {name!r} is of type {type(upsampler).__name__}; make it a function (image, size) -> image")
    return partial(_enlarged, name, upsampler)


def _enlarged(name: str, upsampler: Upsampler, image: Tensor, size: tuple[int, int]) -> Tensor:
    """What an upsampler makes of an image, [size[0], size[1], 3]. Raises PluginError."""
    with naming(f"upsampler {name!r}"):
        made: Any = upsampler(image.clone() if is_third_party(upsampler) else image, size)
    wanted = f"upsampler {name!r} has to return an image {[*size, 3]} of finite {image.dtype}"
    if isinstance(made, Tensor) and made.device != image.device:
        raise PluginError(f"{wanted}, on {image.device}, where it got one; it returned one on {made.device}")
    if not isinstance(made, Tensor) or tuple(made.shape) != (*size, 3) or made.dtype != image.dtype or not made.isfinite().all():
        raise PluginError(f"{wanted}; it returned {_described(made)}")
    low, high = (float(end) for end in made.aminmax())
    if not LOWEST <= low <= high <= HIGHEST:
        raise PluginError(f"{wanted}, whose colors are 0..1; those that it returned are {low:.3g} to {high:.3g}")
    return made


def _described(made: Any) -> str:
    if not isinstance(made, Tensor):
        return type_of(made)
    return f"{list(made.shape)} in {made.dtype}{'' if made.isfinite().all() else ', not all finite'}"


def check_upsampler(name: str) -> None:
    """Raise SettingsError if there is no upsampler of this name, without loading any."""
    known = UPSAMPLERS.names()
    if name in known:
        return
    if not name.endswith(SUFFIXES):
        raise SettingsError(f"there is no upsampler {name!r}; choose from {', '.join(known)}, or give the file of a network ({', '.join(SUFFIXES)})")
    if not _file(name).is_file():
        raise SettingsError(f"there is no upsampler file {name}; check the path")


def network_input(name: str) -> dict[str, str]:
    """A hash of the network that an adaptation is given, if it is a file, as its provenance records it (`Report.inputs`); empty without one."""
    is_file = name not in UPSAMPLERS.names() and _file(name).is_file()
    return {"network": sha256(_file(name))} if is_file else {}


@contextmanager
def placed(name: str, file: Path | None) -> Iterator[None]:
    """Inside, read the network that settings name from `file`, unless that is None."""
    token = _PLACED.set(None if file is None else (name, file))
    try:
        yield
    finally:
        _PLACED.reset(token)


def _file(name: str) -> Path:
    placed_here = _PLACED.get()
    return placed_here[1] if placed_here and placed_here[0] == name else Path(name)


def bicubic(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize with Keys' cubic, a = -0.5, as Pillow does."""
    return resize(image, size, "pil-bicubic")


def lanczos(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize with Lanczos' kernel of three lobes, as Pillow does."""
    return resize(image, size, "lanczos")
