"""Half a turn about x, exact: it changes signs only."""

from __future__ import annotations

import math
import re
from pathlib import Path

from mipmap_plugin.formats.ply import read_ply, write_ply


def half_turned(path: Path) -> None:
    """Turn the splats of a 3DGS PLY by half a turn about x: y and z change their signs."""
    ply = read_ply(path)
    rest = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in ply.columns)
    negated = {"y", "z", "ny", "nz", "rot_2", "rot_3"}  # the quaternion also turns about the splat's own x, which does not change its shape
    negated |= {f"f_rest_{i}" for i in range(rest) if _is_odd(i % (rest // 3) + 1)}
    columns = {name: -column if name in negated else column for name, column in ply.columns.items()}
    write_ply(path, columns, ply.comments, overwrite=True)


def _is_odd(coefficient: int) -> bool:
    """Whether a spherical harmonic, numbered from 0 for degree 0, changes its sign with y and z: those of negative orders change it with y, and those
    whose degree and order differ by an odd number with z."""
    degree = math.isqrt(coefficient)
    order = coefficient - degree * (degree + 1)
    return (order < 0) != ((degree - order) % 2 == 1)
