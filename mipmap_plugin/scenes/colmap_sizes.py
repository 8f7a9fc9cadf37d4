"""Check that COLMAP's binary files are as long as their counts say: pycolmap reads beyond the end of truncated ones, for hours."""

from __future__ import annotations

import mmap
import struct
from dataclasses import dataclass
from pathlib import Path

from mipmap_plugin.errors import SceneError


@dataclass(frozen=True)
class Rows:
    """Layout of a file's rows, in bytes (COLMAP, src/colmap/scene/reconstruction_io_binary.cc)."""

    fixed: int  # size of a row before its name and its list
    has_name: bool = False  # whether a zero-terminated text follows
    count: str = ""  # struct format of the length of the row's list; empty: there is no list
    each: int = 0  # size of an item of the list
    optional: int = 0  # size of what an item has after it, but for the first, if the byte between them is not 0


FILES = {
    "cameras.bin": Rows(24),  # followed by parameters, whose number depends on the camera model
    "images.bin": Rows(64, has_name=True, count="<Q", each=24),
    "points3D.bin": Rows(43, count="<Q", each=8),
    "rigs.bin": Rows(4, count="<I", each=8, optional=56),  # the poses of sensors, in that of the first
    "frames.bin": Rows(64, count="<I", each=16),
}


def refuse_truncated(folder: Path) -> None:
    """Raise SceneError if a file of the binary model in `folder` is shorter than its counts say."""
    for name, rows in FILES.items():
        path = folder / name
        if path.is_file() and not _is_whole(path, rows):
            raise SceneError(f"{path}: is truncated or damaged, for it is shorter than its own counts say; copy or export it again")


def _is_whole(path: Path, rows: Rows) -> bool:
    size = path.stat().st_size
    if size < 8:
        return False
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        (declared,) = struct.unpack_from("<Q", content)
        if declared * max(1, rows.fixed) > size:
            return False
        return rows.each == 0 or _end(content, rows, declared) <= size


def _end(content: mmap.mmap, rows: Rows, declared: int) -> int:
    """The end of the last row, or a position beyond the content if it is truncated."""
    at, beyond = 8, len(content) + 1
    length = struct.Struct(rows.count)
    for _ in range(declared):
        at += rows.fixed
        if rows.has_name and at < len(content):
            at = content.find(b"\0", at) + 1 or beyond
        if at + length.size > len(content):
            return beyond
        (items,) = length.unpack_from(content, at)
        at += length.size
        if not rows.optional:
            at += rows.each * items
            continue
        at += rows.each * min(1, items)
        for _ in range(items - 1):
            at += rows.each
            if at >= len(content):
                return beyond
            at += 1 + rows.optional * bool(content[at])
    return at
