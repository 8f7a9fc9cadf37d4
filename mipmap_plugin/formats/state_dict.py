"""The weights of a network, read from a torch file as data: nothing in the file is executed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import linear

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


def shapes_of(layers: Mapping[str, tuple[int, ...]]) -> dict[str, tuple[int, ...]]:
    """The shapes of the weights and biases of linear layers, by their names in a state dict. `layers`: (outputs, inputs) of each."""
    return {f"{name}.weight": shape for name, shape in layers.items()} | {f"{name}.bias": shape[:1] for name, shape in layers.items()}


def run_layer(state: Mapping[str, Tensor], name: str, inputs: Tensor) -> Tensor:
    """The outputs [N, B] of the linear layer `name` for `inputs` [N, A]."""
    return linear(inputs, state[f"{name}.weight"], state[f"{name}.bias"])
