"""Checks of arguments: types, names, paths, scales, seeds, background colors, and images that fit into a machine's memory."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mipmap_plugin.errors import SettingsError

if TYPE_CHECKING:
    import torch

# Scales beyond these show nothing: a photograph would be far below a pixel, or one of its pixels larger than any screen; and splats as large
# as a pixel would leave the range that files may have (`models.health.LARGEST`).
MIN_SCALE, MAX_SCALE = 1e-9, 1e4

# The largest seed of torch's random number generators.
MAX_SEED = 2**63 - 1

# Minimum bytes per pixel while an image is rendered: three 32-bit colors, the transmittance, and their copies.
BYTES_PER_PIXEL = 32


def check_scale(scale: Any) -> float:
    """Return a number of any type as a scale. Raises SettingsError for what is no number, or out of range."""
    try:
        number = math.nan if isinstance(scale, (str, bool)) else float(scale)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        number = math.nan
    if not MIN_SCALE <= number <= MAX_SCALE:  # also for NaN
        got = f"{scale:g}" if isinstance(scale, float) else repr(scale)[:40]
        several = "; give one at a time" if isinstance(scale, (list, tuple)) else ""
        raise SettingsError(f"scale must be from {MIN_SCALE:g} to {MAX_SCALE:g}, a number such as 0.25 or 4, got {got}{several}")
    return number


def path_of(path: Any, name: str = "path") -> Path:
    """Return what was given as a path, "~" as the home folder. Raises SettingsError for anything else than a path, and for an empty one."""
    if not isinstance(path, (str, Path)) or not str(path):
        got = "an empty text" if isinstance(path, str) else type(path).__name__
        raise SettingsError(f"{name} must be a text such as 'output/bicycle', or a pathlib.Path, got {got}")
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise SettingsError(f"{path}: there is no home folder of that name; write the path in full") from error


def check_kinds(**given: tuple[Any, Any]) -> None:
    """Raise SettingsError for arguments, by name, that are neither None nor of the kind that each has to be."""
    for name, (value, kind) in given.items():
        if value is not None and not isinstance(value, kind):
            raise SettingsError(f"{name} must be a {getattr(kind, '__name__', kind)}, got {type(value).__name__}")


def check_names(function: str, options: Mapping[str, Any], kind: type, beside: Sequence[str]) -> None:
    """Raise TypeError for options that are not among those of `kind`, a TypedDict, as Python does for arguments that a function lacks.

    `beside`: the arguments that it has beside them.
    """
    if unknown := options.keys() - kind.__annotations__.keys():
        known = ", ".join((*beside, *kind.__annotations__))
        raise TypeError(f"{function}() got unknown options: {', '.join(sorted(unknown))}; there are {known}")


def derived_seed(seed: int, number: int) -> int:
    """The seed for random draw `number` of a run; multiplied by a prime, so that the seeds of different runs do not coincide."""
    return (seed * 1_000_003 + number) % (MAX_SEED + 1)


def check_background(background: Sequence[float]) -> tuple[float, float, float]:
    """Return the color. Raises SettingsError if it is not three numbers from 0 to 1."""
    try:
        color = tuple(float(channel) for channel in background)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        color = ()
    if len(color) != 3 or not all(0 <= channel <= 1 for channel in color):
        raise SettingsError(f"background must be three numbers from 0 to 1, such as (1, 1, 1), got {background!r}")
    return color


def check_image(width: int, height: int, device: torch.device | str = "cpu", bytes_per_pixel: int = BYTES_PER_PIXEL) -> None:
    """Raise SettingsError for an image of `width` x `height` px that the memory of `device` cannot hold."""
    needed, available = width * height * bytes_per_pixel, memory(device)
    if needed > available:
        message = f"an image of {width:,} x {height:,} px needs at least {needed / 2**30:,.0f} GiB of memory"
        raise SettingsError(f"{message}, and this machine has {available / 2**30:,.1f}; use a smaller scale or smaller cameras")


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error of any library means that memory ran out."""
    from_torch = isinstance(error, RuntimeError) and (type(error).__name__ == "OutOfMemoryError" or "allocate memory" in str(error))
    return isinstance(error, MemoryError) or from_torch


def memory(device: torch.device | str) -> float:
    """The memory of a device in bytes; infinite if the system does not report it."""
    if str(device).startswith("cuda"):
        import torch  # not before it is needed: the command line reads its options without

        return torch.cuda.get_device_properties(device).total_memory
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows
        return math.inf
