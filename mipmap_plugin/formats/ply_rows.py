"""The rows of a PLY on the disk, read when they are asked for: a file may be larger than the memory."""

from __future__ import annotations

import mmap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.atomic import new_file
from mipmap_plugin.formats.ply import BYTE_ORDER, Header, header_of_rows, read_header

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


def concatenate(path: Path, files: Sequence[Path], comments: Iterable[str], *, overwrite: bool = False) -> Path:
    """Write a PLY of the vertex rows of `files`, one after the other, which have the same columns; return its path. Atomic.

    The files are binary, little endian, and hold nothing behind these rows, as `write_ply` leaves them. Bytes are copied, and none is
    parsed. Raises CheckpointError for files of different columns, and what `write_ply` raises.
    """
    headers = [read_header(file) for file in files]
    count, first = sum(header.vertex.count for header in headers), headers[0].vertex
    for file, header in zip(files, headers, strict=True):
        if header.vertex.properties != first.properties or header.format != "binary_little_endian":
            raise CheckpointError(f"{file} has other columns than {files[0]}, so they are not parts of one scene; delete them to make them again")
    head = header_of_rows(path, first.dtype("<"), count, comments)
    with new_file(path, overwrite) as temporary, temporary.open("xb") as out:
        out.write(head)
        for file, header in zip(files, headers, strict=True):
            _copy(file, body_of(file, header), header.vertex.count * header.vertex.stride, out)
    return path


def _copy(path: Path, start: int, size: int, out: IO[bytes]) -> None:
    with path.open("rb") as file:
        file.seek(start)
        while size > 0:
            block = file.read(min(BLOCK, size))
            out.write(block)
            size -= len(block)
