"""What a model holds at one moment, to be put back later."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.models.base import SplatModel


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Copies of a model's parameters."""

    rows: dict[str, Tensor]  # by name, row by row
    shared: dict[str, Tensor]
    rows_changed: bool = False  # splats were added or removed since the run began

    @classmethod
    def of(cls, model: SplatModel, rows_changed: bool = False) -> Snapshot:
        rows, shared = ({name: tensor.detach().clone() for name, tensor in held.items()} for held in (model.parameters(), model.shared_parameters()))
        return cls(rows, shared, rows_changed)

    def over(self, initial: SplatModel) -> SplatModel:
        """A model that holds the snapshot; `initial`: the model as the run began with it.

        What that carries along by row besides, such as columns of its file, goes where rows have changed, even if they are as many.
        """
        model = initial.copy()
        if self.rows_changed:
            model.replace_parameters({name: tensor.clone().requires_grad_() for name, tensor in self.rows.items()})
        self.put_into(model)
        return model

    @torch.no_grad()
    def put_into(self, model: SplatModel) -> None:
        """Let `model`, a copy of what the snapshot is of, hold it: in its own leaves where there are as many rows."""
        held = model.parameters()
        if len(held["means"]) != len(self.rows["means"]):
            model.replace_parameters({name: tensor.clone().requires_grad_() for name, tensor in self.rows.items()})
        else:
            for name, tensor in held.items():
                tensor.copy_(self.rows[name])
        for name, tensor in model.shared_parameters().items():
            tensor.copy_(self.shared[name])

    def to(self, device: torch.device) -> Snapshot:
        rows, shared = ({name: tensor.to(device) for name, tensor in held.items()} for held in (self.rows, self.shared))
        return Snapshot(rows, shared, self.rows_changed)
