"""Raw parameters of splats in a file of the work folder, laid out as they are used: a PLY's columns would be collected one by one in each view.

The file is a header of 16 bytes (the number of splats and of SH coefficients), then 11 numbers of each splat (mean, log scales, quaternion,
logit of the opacity), then the SH coefficients of each, all little-endian float32.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterable
from pathlib import Path

import torch
from torch import Tensor

from mipmap_plugin.formats.atomic import new_file

HEADER = struct.Struct("<qq")

# What stands before the SH coefficients, and where each part begins.
NAMES, WIDTHS = ("means", "scales", "quats", "opacities"), (3, 3, 4, 1)
SHAPE = sum(WIDTHS)

FLOAT = 4  # bytes

# Rows that are written at a time.
PIECE = 1 << 14


class Store:
    """The splats of a file, mapped into memory."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            count, coefficients = HEADER.unpack(file.read(HEADER.size))
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)  # torch wants memory that could be written to
        shapes = count * SHAPE
        numbers = torch.frombuffer(self._map, dtype=torch.float32, offset=HEADER.size)
        self.shapes = numbers[:shapes].view(count, SHAPE)
        self.sh = numbers[shapes:].view(count, coefficients, 3)

    def __len__(self) -> int:
        return len(self.shapes)

    def read(self, rows: Tensor, shapes: Tensor, sh: Tensor | None) -> None:
        """Write both parts of rows [M] to `shapes` [M, 11] and, where it is given, to `sh` [M, K, 3]."""
        if len(rows):
            torch.index_select(self.shapes, 0, rows, out=shapes)
            if sh is not None:
                torch.index_select(self.sh, 0, rows, out=sh)
            self.release()

    def parameters(self) -> dict[str, Tensor]:
        """Copies of the raw parameters of all rows."""
        shapes, sh = self.shapes.clone(), self.sh.clone()
        self.release()
        return as_parameters(shapes, sh)

    def release(self) -> None:
        """Give the memory of what was read back to the system; later reads find it in the system's cache, or on the disk."""
        if hasattr(mmap, "MADV_DONTNEED"):  # not on Windows
            self._map.madvise(mmap.MADV_DONTNEED)


def as_parameters(shapes: Tensor, sh: Tensor) -> dict[str, Tensor]:
    """The raw parameters by name, of rows of the two parts of a file [M, 11] and [M, K, 3]."""
    parts = dict(zip(NAMES, (part.contiguous() for part in shapes.split(WIDTHS, dim=1)), strict=True))
    return {**parts, "opacities": parts["opacities"][:, 0], "sh0": sh[:, :1], "shN": sh[:, 1:]}


def write_store(path: Path, parameters: dict[str, Tensor]) -> None:
    """Write splats with these raw parameters, atomically; an old file is replaced. Raises OutputError."""
    count = len(parameters["means"])
    write_pieces(path, count, ({name: rows[start : start + PIECE] for name, rows in parameters.items()} for start in range(0, count, PIECE)))


def write_pieces(path: Path, count: int, pieces: Iterable[dict[str, Tensor]]) -> None:
    """Write `count` splats, whose raw parameters come in pieces, atomically; an old file is replaced. Raises OutputError."""
    with new_file(path, overwrite=True) as temporary, temporary.open("wb") as file:
        done = 0
        for piece in pieces:
            raw = {name: tensor.detach() for name, tensor in piece.items()}
            shapes = torch.cat([raw[name].reshape(len(raw["means"]), -1) for name in NAMES], dim=1)
            sh = torch.cat([raw["sh0"], raw["shN"]], dim=1)
            if not done:
                file.write(HEADER.pack(count, sh.shape[1]))
            file.seek(HEADER.size + FLOAT * SHAPE * done)
            file.write(shapes.numpy().tobytes())
            file.seek(HEADER.size + FLOAT * (SHAPE * count + sh.shape[1] * 3 * done))
            file.write(sh.numpy().tobytes())
            done += len(shapes)
