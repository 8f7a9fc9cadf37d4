"""What fVDB Reality Capture (NVIDIA) writes into a PLY beside its splats: settings as comments, tensors as elements of one property, `value`.

A comment is `MAGIC`, the key, and two fields behind bars: `|int64|1`, `|double|0.3`, or `|tensor|3,88,4,4`, a tensor's number of dimensions and its
shape (openvdb/fvdb-core, eb2f410f, src/fvdb/detail/io/GaussianPlyIO.cpp).
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from mipmap_plugin.screen_filters import COMPENSATED

MAGIC = "fvdb_ply_af_8198767135"


def settings_of(comments: Iterable[str]) -> dict[str, str]:
    """The settings that are no tensors, as text, by key."""
    split = (comment.removeprefix(MAGIC).split("|", 2) for comment in comments if comment.startswith(MAGIC))
    return {fields[0]: fields[2] for fields in split if len(fields) == 3 and fields[1] != "tensor"}


def filter_of(comments: Iterable[str]) -> tuple[str, float] | None:
    """Name and dilation (px²) of the screen filter of the training; None where no comment tells both."""
    settings = settings_of(comments)
    try:
        antialias, eps2d = int(settings["antialias"]), float(settings["eps2d"])
    except (KeyError, ValueError):
        return None
    return ("antialiased" if antialias else "classic", eps2d) if 0 <= eps2d < math.inf else None


def rewritten(comments: Iterable[str], screen_filter: str, eps2d: float | None) -> list[str]:
    """`comments` for a file of this screen filter without other elements: fVDB opens no file without an element that a comment names."""
    new = {"antialias": f"int64|{int(screen_filter in COMPENSATED)}", **({} if eps2d is None else {"eps2d": f"double|{eps2d:.17g}"})}
    told = [comment for comment in comments if not (comment.startswith(MAGIC) and comment.partition("|")[2].startswith("tensor|"))]
    keys = [comment.removeprefix(MAGIC).partition("|")[0] if comment.startswith(MAGIC) else "" for comment in told]
    return [f"{MAGIC}{key}|{new[key]}" if key in new else comment for key, comment in zip(keys, told, strict=True)]
