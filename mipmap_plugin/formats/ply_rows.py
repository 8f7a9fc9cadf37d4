"""The rows of a PLY on the disk, read when they are asked for: a file may be larger than the memory."""

from __future__ import annotations

import mmap
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

import numpy as np

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.ply import BYTE_ORDER, Header, read_header

# Bytes that are copied at a time.
BLOCK = 1 << 22


class PlyRows:
    """The `vertex` rows of a binary PLY, mapped into memory."""

    def __init__(self, path: Path) -> None:
        """Raises CheckpointError for a file that is damaged, or whose rows have no fixed place in it."""
        self.path, self.header = path, read_header(path)
        start = body_of(path, self.header)
        vertex = self.header.vertex
        self._rows: Any = np.memmap(path, vertex.dtype(BYTE_ORDER[self.header.format]), "r", start, (vertex.count,))

    def __len__(self) -> int:
        return len(self._rows)

    def columns(self, rows: slice | np.ndarray) -> dict[str, np.ndarray]:
        """The columns of some rows, by name: those of a slice, or of indices [M]."""
        taken = np.array(self._rows[rows])
        return {name: taken[name] for name in self.header.vertex.names}

    def release(self) -> None:
        """Give the memory of what was read back to the system; later reads find it in the system's cache, or on the disk."""
        if hasattr(mmap, "MADV_DONTNEED"):  # not on Windows
            self._rows._mmap.madvise(mmap.MADV_DONTNEED)


def body_of(path: Path, header: Header) -> int:
    """Bytes before the first vertex row. Raises CheckpointError if that is not known from the header."""
    before = header.before(header.vertex)
    if header.format == "ascii" or any(element.has_lists for element in before):
        which = "a binary PLY" if header.format == "ascii" else "a PLY without lists before its splats"
        raise CheckpointError(f"{path}: only {which} is read part by part; save it as one, or adapt it without tiles")
    return header.body + sum(element.count * element.stride for element in before)


def concatenate(files: Iterable[Path], comments: Iterable[str], out: IO[bytes]) -> int:
    """Write a PLY of the vertex rows of `files`, one after the other, which have the same columns; return the number of rows.

    The files are binary, little endian, and hold nothing behind these rows, as `write_ply` leaves them. Bytes are copied, and none is
    parsed. Raises CheckpointError for files of different columns.
    """
    paths = list(files)
    headers = [read_header(path) for path in paths]
    count, properties = sum(header.vertex.count for header in headers), headers[0].vertex.properties
    for path, header in zip(paths, headers, strict=True):
        if header.vertex.properties != properties or header.format != "binary_little_endian":
            raise CheckpointError(f"{path} has other columns than {paths[0]}, so they are not parts of one scene; delete them to make them again")
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments), f"element vertex {count}"]
    lines += [f"property {kind} {name}" for name, kind in properties]
    out.write("\n".join([*lines, "end_header", ""]).encode("ascii", "backslashreplace"))
    for path, header in zip(paths, headers, strict=True):
        _copy(path, body_of(path, header), header.vertex.count * header.vertex.stride, out)
    return count


def _copy(path: Path, start: int, size: int, out: IO[bytes]) -> None:
    with path.open("rb") as file:
        file.seek(start)
        while size > 0:
            block = file.read(min(BLOCK, size))
            out.write(block)
            size -= len(block)
