"""Ends of what can be asked for: zooms, colors, and images that a machine has memory for."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from mipmap_plugin.errors import SettingsError

if TYPE_CHECKING:
    import torch

# Zooms beyond these show nothing, and splats as large as their pixels leave the range that is read (`models.health.LARGEST`): a photograph
# would be far below a pixel, or one of its pixels larger than any screen.
LEAST_SCALE, MOST_SCALE = 1e-9, 1e4

# Seeds above it fit no generator of random numbers.
MOST_SEED = 2**63 - 1

# Bytes of a pixel at least, while an image is drawn: three 32-bit colors, the transmittance, and their copies.
BYTES_PER_PIXEL = 32


def check_scale(scale: float) -> float:
    """The zoom itself. Raises SettingsError for one that nothing can be adapted to or drawn at."""
    if not LEAST_SCALE <= scale <= MOST_SCALE:  # nor is a NaN
        raise SettingsError(f"scale {scale:g} is no zoom; give a number from {LEAST_SCALE:g} to {MOST_SCALE:g}, such as 0.25 or 4")
    return scale


def mixed(seed: int, number: int) -> int:
    """The seed of a run's draw `number`; by a prime, so that those of different runs do not meet."""
    return (seed * 1_000_003 + number) % (MOST_SEED + 1)


def check_background(background: Sequence[float]) -> tuple[float, float, float]:
    """The color itself. Raises SettingsError for one that is not three numbers from 0 to 1."""
    try:
        color = tuple(float(each) for each in background)
    except (TypeError, ValueError, OverflowError):
        color = ()
    if len(color) != 3 or not all(0 <= each <= 1 for each in color):
        raise SettingsError(f"background {background!r} is no color; give three numbers from 0 to 1, such as (1, 1, 1)")
    return color


def check_image(width: int, height: int, device: torch.device | str = "cpu", bytes_per_pixel: int = BYTES_PER_PIXEL) -> None:
    """Raise SettingsError for an image of `width` x `height` px that the memory of `device` cannot hold."""
    needed, held = width * height * bytes_per_pixel, memory(device)
    if needed > held:
        told = f"an image of {width:,} x {height:,} px takes {needed / 2**30:,.0f} GiB at least"
        raise SettingsError(f"{told}, and this machine has {held / 2**30:,.1f}; ask for a smaller scale, or give smaller cameras")


def is_out_of_memory(error: BaseException) -> bool:
    """Whether a library says in its own way that the memory does not suffice."""
    torchs = isinstance(error, RuntimeError) and (type(error).__name__ == "OutOfMemoryError" or "allocate memory" in str(error))
    return isinstance(error, MemoryError) or torchs


def memory(device: torch.device | str) -> float:
    """Bytes of a device's memory; infinite where the system does not tell."""
    if str(device).startswith("cuda"):
        import torch  # not before it is needed: the command line reads its options without

        return torch.cuda.get_device_properties(device).total_memory
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows
        return math.inf
