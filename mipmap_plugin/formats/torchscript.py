"""Reading the weights of a TorchScript archive without executing it, as `torch.jit.load` would.

The archive is a zip: `<root>/data.pkl` is a pickle of modules, whose classes are code under `<root>/code`, and `<root>/data/<key>` are
the bytes of the tensors. Here the code is ignored, and every class becomes a plain record of its attributes.
"""

from __future__ import annotations

import collections
import io
import math
import pickle
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.magic import read_head
from mipmap_plugin.formats.pickles import refuse_packed, scan

# Bytes. The networks of an anchor model take 30 kB, appearance embeddings for thousands of photographs a few MB.
MAX_PICKLE = 1024 * 1024

# Nesting of modules, and total length of the names of all weights: both far beyond any real network.
MAX_DEPTH = 64
MAX_LETTERS = MAX_PICKLE

# Weights may share storage, and each gets a copy: total size of the copies relative to the file.
MOST_SHARED = 4

# What a pickle calls the types of storages.
DTYPES = {
    "DoubleStorage": torch.float64, "FloatStorage": torch.float32, "HalfStorage": torch.float16, "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64, "IntStorage": torch.int32, "ShortStorage": torch.int16, "CharStorage": torch.int8,
    "ByteStorage": torch.uint8, "BoolStorage": torch.bool,
}  # fmt: skip


def read_torchscript(path: str | Path) -> dict[str, Tensor]:
    """The parameters by their dotted names, as `state_dict` would call them. Raises CheckpointError for anything else than weights."""
    path = Path(path)
    read_head(path)
    try:
        with zipfile.ZipFile(path) as archive:
            refuse_packed(archive, path)
            root = next(name for name in archive.namelist() if name.endswith("/data.pkl")).removesuffix("/data.pkl")
            order = f"{root}/byteorder"
            if order in archive.namelist() and _member(archive, order, 16) != b"little":
                raise ValueError("its numbers are big-endian")
            program = _member(archive, f"{root}/data.pkl", MAX_PICKLE)
            scan(io.BytesIO(program), None)
            return _tensors(_Weights(program, archive, root, MOST_SHARED * path.stat().st_size).load())
    except Exception as error:  # a damaged or hostile pickle may fail in any way, and all of them mean the same here
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise CheckpointError(f"{path} is no TorchScript network whose weights can be read without executing it ({reason})") from error


class _Module:
    """Replaces every class of the archive; keeps its state and calls nothing."""

    def __init__(self) -> None:
        self.attributes: Any = {}

    def __setstate__(self, state: Any) -> None:
        self.attributes = state


@dataclass(frozen=True)
class _Storage:
    """The location of a tensor's numbers in the archive."""

    dtype: torch.dtype
    key: str
    count: int


class _Weights(pickle.Unpickler):
    """An unpickler that creates tensors, dictionaries and records only."""

    def __init__(self, program: bytes, archive: zipfile.ZipFile, root: str, most: int) -> None:
        """`most`: limit of the bytes of all weights."""
        super().__init__(io.BytesIO(program))
        self._archive, self._root = archive, root
        self._left = most

    def find_class(self, module: str, name: str) -> Any:
        if module.split(".")[0] == "__torch__":
            return _Module
        if module == "torch" and name in DTYPES:
            return DTYPES[name]
        if (module, name) == ("collections", "OrderedDict"):
            return collections.OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return self._tensor
        raise pickle.UnpicklingError(f"it asks for {module}.{name}")

    def persistent_load(self, reference: Any) -> _Storage:
        _, dtype, key, _, count = reference
        return _Storage(dtype, str(key), int(count))

    def _tensor(self, storage: _Storage, offset: int, shape: tuple[int, ...], strides: tuple[int, ...], *_: Any) -> Tensor:
        """A tensor with its own storage. Offset and strides are checked first, since wrong ones would read other memory."""
        last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
        if min((offset, *shape, *strides)) < 0 or (math.prod(shape) > 0 and last >= storage.count):
            raise ValueError("a tensor lies outside its storage")
        size = storage.count * storage.dtype.itemsize
        self._left -= max(size, math.prod(shape) * storage.dtype.itemsize)
        if self._left < 0:
            raise ValueError("its tensors claim more numbers than the file holds")
        content = _member(self._archive, f"{self._root}/data/{storage.key}", size)
        if len(content) != size:
            raise ValueError("a storage is shorter than declared")
        if not size:
            return torch.empty(shape, dtype=storage.dtype)
        return torch.frombuffer(bytearray(content), dtype=storage.dtype).as_strided(shape, strides, offset).clone()


def _member(archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    """The bytes of a member, at most `most`."""
    with archive.open(name) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise ValueError(f"{name} is larger than {most:,} bytes")
    return content


def _tensors(root: Any) -> dict[str, Tensor]:
    """The tensors in nested records, by dotted name. Every record is visited once, because records may be cyclic."""
    tensors: dict[str, Tensor] = {}
    entered: set[int] = set()
    letters = 0
    pending: list[tuple[tuple[str, ...], Any]] = [((), root)]
    while pending:
        names, value = pending.pop()
        if len(names) > MAX_DEPTH or letters > MAX_LETTERS:
            raise ValueError("its modules are nested too deep, or their names too long")
        if isinstance(value, Tensor):
            letters += sum(map(len, names))
            tensors[".".join(names)] = value
        if isinstance(value, _Module) and id(value) not in entered:
            entered.add(id(value))
            pending += [((*names, str(key)), child) for key, child in dict(value.attributes).items()]
    if not tensors:
        raise ValueError("it holds no weights")
    return tensors
