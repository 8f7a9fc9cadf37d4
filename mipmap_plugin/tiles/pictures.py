"""Pictures in one file, each read by itself when it is needed, so that memory holds one at a time."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from mipmap_plugin.formats.atomic import new_file

# The last bytes of a file: where its table begins.
END = struct.Struct("<q")

KINDS = {"half": torch.float16, "int16": torch.int16, "uint8": torch.uint8}

Box = tuple[int, int, int, int]  # left, top, right, bottom, px of the view


class _Entry(NamedTuple):
    path: Path
    start: int  # byte
    shape: tuple[int, ...]
    kind: str  # of `KINDS`
    box: Box  # what it shows of its view


@contextmanager
def new_pictures(path: Path) -> Iterator[Callable[[str, Tensor, Box | None], None]]:
    """A function that writes a picture of a type of `KINDS` by name, and what it shows of its view (None: all).

    The file is there when the block succeeds; an old one is replaced. Raises OutputError.
    """
    names = {kind: name for name, kind in KINDS.items()}
    table = {}
    with new_file(path, overwrite=True) as temporary, temporary.open("wb") as file:

        def write(name: str, picture: Tensor, box: Box | None) -> None:
            table[name] = (file.tell(), picture.shape, names[picture.dtype], box or (0, 0, picture.shape[1], picture.shape[0]))
            file.write(picture.contiguous().view(-1).view(torch.uint8).numpy().tobytes())

        yield write
        start = file.tell()
        file.write(json.dumps(table).encode())
        file.write(END.pack(start))


class Album:
    """The pictures of several files, by name."""

    def __init__(self, paths: Iterable[Path]) -> None:
        self._entries = {name: entry for path in paths for name, entry in _table(path).items()}

    def __contains__(self, name: str) -> bool:
        return name in self._entries

    def __getitem__(self, name: str) -> Tensor:
        """A picture, read anew each time."""
        entry = self._entries[name]
        picture = torch.empty(entry.shape, dtype=KINDS[entry.kind])
        with entry.path.open("rb") as file:
            file.seek(entry.start)
            file.readinto(picture.view(-1).view(torch.uint8).numpy().data)
        return picture

    def box(self, name: str) -> Box:
        """What a picture shows of its view."""
        return self._entries[name].box


def _table(path: Path) -> dict[str, _Entry]:
    with path.open("rb") as file:
        file.seek(-END.size, 2)
        end = file.tell()
        (start,) = END.unpack(file.read(END.size))
        file.seek(start)
        table = json.loads(file.read(end - start))
    return {name: _Entry(path, start, tuple(shape), kind, tuple(box)) for name, (start, shape, kind, box) in table.items()}
