"""Files of torch.save, read and written as data: of what a pickle may name, only tensors, plain values and NumPy scalars are made."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.files import new_file
from mipmap_plugin.models.magic import read_head

_SCALAR: Any = np.float64(0).__reduce__()[0]


def _scalar_of(module: str) -> Any:
    """What makes NumPy's scalars under the name that it has in `module`; torch takes the names of what is safe from the functions themselves."""

    def scalar(*values: Any) -> Any:
        return _SCALAR(*values)

    scalar.__module__, scalar.__qualname__ = module, "scalar"
    return scalar


# What a NumPy scalar is pickled as, by NumPy 2 and by NumPy 1; learning-rate schedulers leave such scalars in checkpoints.
_SAFE: list[Any] = [
    *map(_scalar_of, ("numpy._core.multiarray", "numpy.core.multiarray")),
    np.dtype,
    *(type(np.dtype(kind)) for kind in (np.float64, np.float32, np.int64, np.int32, np.bool_)),
]


def load_torch(path: Path) -> Any:
    """The content of a torch file, on the CPU. Raises CheckpointError for a damaged one, or one that would run code or fill the memory."""
    read_head(path, 512)
    try:
        with _allowing_scalars():
            content = torch.load(path, map_location="cpu", weights_only=True)
        for tensor in _tensors(content):
            _refuse_unusual(tensor)
        return content
    except Exception as error:  # a damaged or hostile pickle may fail in any way
        reason = (str(error).splitlines() or [type(error).__name__])[0][:160]
        raise CheckpointError(f"{path} is damaged, or holds more than plain tensors and is not executed; save it again ({reason})") from error


def _allowing_scalars() -> AbstractContextManager[None]:
    """NumPy's scalars may be read inside; older torch can be told of no exceptions and refuses a file with some, by their name."""
    return torch.serialization.safe_globals(_SAFE) if hasattr(torch.serialization, "safe_globals") else nullcontext()


def _tensors(content: Any) -> Iterator[Tensor]:
    """Every tensor in nested containers; of containers that hold themselves, each once."""
    ahead, entered = [content], set()
    while ahead:
        value = ahead.pop()
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, (Mapping, list, tuple, set)) and id(value) not in entered:
            entered.add(id(value))
            ahead += value.values() if isinstance(value, Mapping) else value


def _refuse_unusual(tensor: Tensor) -> None:
    """Only numbers that lie in the file, one after the other, are known to compute as others do and to take no more room than the file."""
    if tensor.layout != torch.strided or tensor.device.type != "cpu" or tensor.is_quantized or tensor.is_complex() or tensor.is_nested:
        raise ValueError("it holds a sparse, quantized, complex, nested or empty-shelled tensor")
    if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
        raise ValueError(f"a tensor of shape {list(tensor.shape)} claims more numbers than the file holds")


def step_and_comments(content: Mapping[str, Any], path: Path) -> tuple[int, tuple[str, ...]]:
    """What a trainer, and this package, write beside the splats; a new file is named by the step. Raises CheckpointError for other things."""
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
        except RuntimeError as error:  # how torch reports a full disk
            raise OSError(str(error).splitlines()[0]) from error
    return path
