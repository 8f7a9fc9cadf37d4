"""Files of torch.save, read and written as data: only tensors, plain values and NumPy scalars are unpickled."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.atomic import new_file
from mipmap_plugin.formats.magic import read_head
from mipmap_plugin.formats.pickles import MOST_PACKED, refuse_hostile

_SCALAR: Any = np.float64(0).__reduce__()[0]
_KINDS = [np.dtype(kind) for kind in (np.float64, np.float32, np.int64, np.int32, np.bool_)]


def _named(module: str, name: str, function: Callable[..., Any]) -> Any:
    """`function` with a name of NumPy's; torch takes the names of safe globals from the functions themselves, before 2.6 the short ones."""

    def stand_in(*values: Any) -> Any:
        return function(*values)

    stand_in.__module__, stand_in.__name__, stand_in.__qualname__ = module, name, name
    return stand_in


def _number_type(name: str, *_: bool) -> np.dtype:
    """A NumPy type of numbers; other types are refused, because their names may request any size."""
    return next(kind for kind in _KINDS if kind.str[1:] == name)


# What a NumPy scalar is pickled as, by NumPy 2 and by NumPy 1; learning-rate schedulers leave such scalars in checkpoints.
_SAFE: list[Any] = [
    *(_named(module, "scalar", _SCALAR) for module in ("numpy._core.multiarray", "numpy.core.multiarray")),
    _named("numpy", "dtype", _number_type),
    *map(type, _KINDS),
]


def load_torch(path: Path) -> Any:
    """The content of a torch file, on the CPU. Raises CheckpointError if it is damaged, or would run code or exhaust the memory."""
    read_head(path, 512)
    try:
        refuse_hostile(path)
        with torch.serialization.safe_globals(_SAFE):
            content = torch.load(path, map_location="cpu", weights_only=True)
        storages: dict[int, int] = {}
        for tensor in _tensors(content):
            _refuse_unusual(tensor)
            storages[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        if sum(storages.values()) > MOST_PACKED * path.stat().st_size:
            raise ValueError("its tensors claim more numbers than the file holds")
        return content
    except Exception as error:  # a damaged or hostile pickle may fail in any way
        raise CheckpointError(f"{path} is damaged, or holds more than plain tensors and is not executed; save it again ({_reason(error)})") from error


def _reason(error: Exception) -> str:
    """The first line of the error, without torch's advice before and after it."""
    text = str(error).rpartition("WeightsUnpickler error:")[2].strip()
    return (text.splitlines() or [type(error).__name__])[0].partition(". Please use")[0][:160]


def _tensors(content: Any) -> Iterator[Tensor]:
    """Every tensor in nested containers, which may be cyclic."""
    pending, entered = [content], set()
    while pending:
        value = pending.pop()
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, (dict, list, tuple, set)) and id(value) not in entered:
            entered.add(id(value))
            if set(getattr(value, "__dict__", ())) - {"_metadata"}:  # torch's own; any other could stand for a method
                raise ValueError("its dictionaries have attributes")
            pending += value.values() if isinstance(value, dict) else value


def _refuse_unusual(tensor: Tensor) -> None:
    """Raise ValueError for tensors other than plain strided ones whose numbers are all in the file."""
    if tensor.layout != torch.strided or tensor.device.type != "cpu" or tensor.is_quantized or tensor.is_complex() or tensor.is_nested:
        raise ValueError("it holds a sparse, quantized, complex, nested or empty-shelled tensor")
    if vars(tensor):
        raise ValueError("a tensor has attributes")
    if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
        raise ValueError(f"a tensor of shape {list(tensor.shape)} claims more numbers than the file holds")


def step_and_comments(content: Mapping[str, Any], path: Path) -> tuple[int, tuple[str, ...]]:
    """The training step, after which new files are named, and the comments of this package. Raises CheckpointError for other types."""
    step, comments = content.get("step", 0), content.get("comments", ())
    if not isinstance(step, int) or step < 0:
        raise CheckpointError(f"{path} is damaged: its step is no whole number; copy it again")
    if not isinstance(comments, (list, tuple)) or not all(isinstance(text, str) for text in comments):
        raise CheckpointError(f"{path} is damaged: its comments are no texts; copy it again")
    return step, tuple(comments)


def save_torch(path: Path, content: Any, *, overwrite: bool) -> Path:
    """Write a torch file atomically; return its path. Raises OutputExists, OutputError."""
    with new_file(path, overwrite) as temporary, temporary.open("wb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:  # torch does not pass on the system's reason
            raise OSError(errno.EIO, "the disk refuses; it may be full") from error
    return path
