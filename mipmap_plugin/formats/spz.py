"""What splat-transform leaves to be done for an SPZ: all the bits that the format has for positions and spherical harmonics, and its frame."""

from __future__ import annotations

import gzip
import math
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mipmap_plugin.formats.magic import GZIP
from mipmap_plugin.formats.ply import read_ply, write_ply

# The header, inside the gzip: magic, version, splats, SH degree, bits of fractions, flags, and a byte that is reserved (nianticlabs/spz).
HEADER = struct.Struct("<4sIIBBBB")

# A coefficient c is stored as ZERO + ONE · c.
ONE, ZERO = 128, 128

# Positions are whole numbers of three bytes, with a sign; of their bits the header says how many are of fractions. The usual writer's 12 are steps of
# 1/4096 unit, which move the small splats of a capture by more than their size. With 24 bits steps are 6e-8 units, which is enough for any scene.
LARGEST_POSITION, MOST_FRACTION = (1 << 23) - 1, 24


def refine(file: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Replace positions and spherical harmonics of an SPZ of version 3 by those of the PLY's `columns` that it was made of, in the same order.

    Any other file is left as it is.
    """
    packed = file.read_bytes()
    if not packed.startswith(GZIP):
        return
    content = gzip.decompress(packed)
    magic, version, count, degree, _, *flags = HEADER.unpack_from(content)
    if version != 3:
        return
    fraction, places = _positions(np.stack([columns[axis] for axis in "xyz"], 1))
    harmonics = _harmonics(columns, count, (degree + 1) ** 2 - 1)
    middle = content[HEADER.size + len(places) : len(content) - len(harmonics)]
    header = HEADER.pack(magic, version, count, degree, fraction, *flags)
    file.write_bytes(gzip.compress(header + places + middle + harmonics, mtime=0))


def fraction_for(farthest: float) -> int:
    """How many bits of fractions fit for coordinates up to `farthest`; below 0 where none does."""
    return min(MOST_FRACTION, math.floor(math.log2(LARGEST_POSITION / max(farthest, 2.0**-MOST_FRACTION))))


def half_turned(path: Path) -> None:
    """Turn the splats of a 3DGS PLY by half a turn about x, which is exact: only signs change, those of y and z among them."""
    ply = read_ply(path)
    rest = sum(name.startswith("f_rest_") for name in ply.columns)
    negated = {"y", "z", "rot_2", "rot_3"}  # the quaternion also turns about the splat's own x, which does not change its shape
    negated |= {f"f_rest_{i}" for i in range(rest) if _is_odd(i % (rest // 3) + 1)}
    columns = {name: -column if name in negated else column for name, column in ply.columns.items()}
    write_ply(path, columns, ply.comments, overwrite=True)


def _is_odd(coefficient: int) -> bool:
    """Whether a spherical harmonic, numbered from 0 for degree 0, changes its sign with y and z: those of negative orders change it with y, and those
    whose degree and order differ by an odd number with z."""
    degree = math.isqrt(coefficient)
    order = coefficient - degree * (degree + 1)
    return (order < 0) != ((degree - order) % 2 == 1)


def _positions(means: np.ndarray) -> tuple[int, bytes]:
    """How many bits of fractions fit for positions [N, 3], and these in so many: 9 bytes each."""
    fraction = fraction_for(float(np.abs(means).max(initial=0.0)))
    codes: np.ndarray = np.rint(means.astype(np.float64) * 2.0**fraction).astype("<i4")
    return fraction, codes.view(np.uint8).reshape(-1, 4)[:, :3].tobytes()


def _harmonics(columns: Mapping[str, np.ndarray], count: int, each: int) -> bytes:
    """The harmonics of `count` splats, `each` for a color, without those of degree 0."""
    if not each:
        return b""
    rest = np.stack([columns[f"f_rest_{number}"] for number in range(3 * each)], 1).reshape(count, 3, each)
    levels: np.ndarray = np.clip(np.rint(rest.astype(np.float64) * ONE) + ZERO, 0, 255).astype(np.uint8).swapaxes(1, 2)
    return levels.tobytes()
