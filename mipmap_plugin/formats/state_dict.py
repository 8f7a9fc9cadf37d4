"""Reading the weights of a network from a torch file as data; nothing in the file is executed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.torch_file import load_torch


def read_state_dict(path: Path) -> dict[str, Tensor]:
    """The tensors of a `state_dict` by name, on the CPU. Raises CheckpointError for any other content, and for weights that are not finite."""
    state = load_torch(path)
    if not isinstance(state, Mapping) or not all(isinstance(name, str) and torch.is_tensor(tensor) for name, tensor in state.items()):
        raise CheckpointError(f"{path} holds other things than the weights of a network by name; give the file that the training saved")
    for name, tensor in state.items():
        if not tensor.isfinite().all():
            raise CheckpointError(f"{path} has weights that are not finite in {name}; the training failed, so take an earlier iteration")
    return dict(state)


def require(state: Mapping[str, Tensor], shapes: Mapping[str, tuple[int, ...]], where: str) -> None:
    """Raise CheckpointError, beginning with `where`, if a tensor is missing or has another shape; -1 matches any size."""
    missing = [name for name in shapes if name not in state]
    if missing:
        names = ", ".join(missing[:3]) + (f" and {len(missing) - 3} more" if len(missing) > 3 else "")
        raise CheckpointError(f"{where}: it lacks {names}")
    for name, wanted in shapes.items():
        shape = tuple(state[name].shape)
        if len(shape) != len(wanted) or any(want not in (-1, size) for size, want in zip(shape, wanted, strict=True)):
            raise CheckpointError(f"{where}: {name} has the shape {list(shape)}, not {list(wanted)}")
