"""Writes the spherical harmonics of an SPZ again with all 8 bits that the format has for a number; its usual writer keeps 5 or 4, to save bytes."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

# The header: magic, version, splats, SH degree, bits of fractions, flags, and a byte that is reserved.
HEADER = struct.Struct("<4sIIBBBB")

# A coefficient c is stored as ZERO + ONE · c.
ONE, ZERO = 128, 128


def refine_harmonics(file: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Replace the spherical harmonics at the end of an SPZ of version 3 by those of the PLY's `columns` that it was made of, in the same order.

    Any other file is left as it is.
    """
    packed = file.read_bytes()
    if not packed.startswith(b"\x1f\x8b"):
        return
    content = gzip.decompress(packed)
    _, version, count, degree, *_ = HEADER.unpack_from(content)
    each = (degree + 1) ** 2 - 1
    if version != 3 or not each:
        return
    rest = np.stack([columns[f"f_rest_{number}"] for number in range(3 * each)], 1).reshape(count, 3, each)
    levels = np.clip(np.rint(rest.astype(np.float64) * ONE) + ZERO, 0, 255).astype(np.uint8).swapaxes(1, 2)
    file.write_bytes(gzip.compress(content[: len(content) - levels.size] + levels.tobytes(), mtime=0))
