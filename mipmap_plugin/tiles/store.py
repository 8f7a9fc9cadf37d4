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
    """The splats of a file, which is mapped into memory only while they are read: Windows neither replaces nor removes a file that is mapped."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with path.open("rb") as file:
            self._count, self.coefficients = HEADER.unpack(file.read(HEADER.size))

    def __len__(self) -> int:
        return int(self._count)

    def mapped(self) -> tuple[Tensor, Tensor]:
        """Both parts of all rows, [N, 11] and [N, K, 3]. What is read of them is in memory until they go."""
        with self._path.open("rb") as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)  # torch wants memory that could be written to
        numbers = torch.frombuffer(content, dtype=torch.float32, offset=HEADER.size)
        shapes = self._count * SHAPE
        return numbers[:shapes].view(self._count, SHAPE), numbers[shapes:].view(self._count, self.coefficients, 3)

    def read(self, rows: Tensor, shapes: Tensor, sh: Tensor | None) -> None:
        """Write both parts of rows [M] to `shapes` [M, 11] and, where it is given, to `sh` [M, K, 3]."""
        if len(rows):
            all_shapes, all_sh = self.mapped()
            torch.index_select(all_shapes, 0, rows, out=shapes)
            if sh is not None:
                torch.index_select(all_sh, 0, rows, out=sh)

    def parameters(self) -> dict[str, Tensor]:
        """Copies of the raw parameters of all rows."""
        return as_parameters(*(part.clone() for part in self.mapped()))


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
