"""Files of torch.save, read and written as data: of what a pickle may name, only tensors, plain values and NumPy scalars are made."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.files import new_file
from mipmap_plugin.models.magic import read_head

# What a NumPy scalar is pickled as, by NumPy 2 and by NumPy 1; learning-rate schedulers leave such scalars in checkpoints.
_SCALAR: Any = np.float64(0).__reduce__()[0]
_SAFE: list[Any] = [
    _SCALAR,
    (_SCALAR, "numpy.core.multiarray.scalar"),
    (_SCALAR, "numpy._core.multiarray.scalar"),
    np.dtype,
    *(type(np.dtype(kind)) for kind in (np.float64, np.float32, np.int64, np.int32, np.bool_)),
]


def load_torch(path: Path) -> Any:
    """The content of a torch file, on the CPU. Raises CheckpointError for a damaged one, or one that would run code."""
    read_head(path, 512)
    try:
        with torch.serialization.safe_globals(_SAFE):
            return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged or hostile pickle may fail in any way
        reason = (str(error).splitlines() or [type(error).__name__])[0][:160]
        raise CheckpointError(f"{path} is damaged, or holds more than plain tensors and is not executed; save it again ({reason})") from error


def save_torch(path: Path, content: Any, *, overwrite: bool) -> Path:
    """Write a torch file atomically; return its path. Raises OutputExists, OutputError."""
    with new_file(path, overwrite) as temporary, temporary.open("wb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:  # how torch reports a full disk
            raise OSError(str(error).splitlines()[0]) from error
    return path
