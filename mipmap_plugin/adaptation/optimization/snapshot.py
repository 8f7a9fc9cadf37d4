"""Copies of a model's parameters at one moment, to be restored later."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.models import contract
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.splatting.bands import neighbors


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Copies of a model's parameters."""

    rows: dict[str, Tensor]  # by name, row by row
    shared: dict[str, Tensor]
    rows_changed: bool = False  # splats were added or removed since the run began

    @classmethod
    def of(cls, model: SplatModel, rows_changed: bool = False) -> Snapshot:
        """A snapshot of the model as it is now."""
        groups = (model.parameters(), model.shared_parameters())
        rows, shared = ({name: tensor.detach().clone() for name, tensor in group.items()} for group in groups)
        return cls(rows, shared, rows_changed)

    @torch.no_grad()
    def renewed(self, model: SplatModel, rows_changed: bool = False) -> Snapshot:
        """A snapshot of the model as it is now, in this one's memory unless it has more rows; this one is not to be used any more."""
        count = len(model.parameters()["means"])
        if count > len(self.rows["means"]):
            return Snapshot.of(model, rows_changed)
        renewed = Snapshot({name: tensor[:count] for name, tensor in self.rows.items()}, self.shared, rows_changed)
        for held, group in ((renewed.rows, model.parameters()), (renewed.shared, model.shared_parameters())):
            for name, tensor in group.items():
                held[name].copy_(tensor)
        return renewed

    def over(self, initial: SplatModel) -> SplatModel:
        """A model with the snapshot's parameters; `initial`: the model at the start of the run.

        Other data of the initial model by row, such as further columns of its file, are removed if rows have changed, even if their number
        is the same.
        """
        model = initial.copy()
        self.put_into(model, anew=self.rows_changed)
        return model

    @torch.no_grad()
    def put_into(self, model: SplatModel, *, anew: bool = False) -> None:
        """Set `model`, a copy of the snapshot's model, to the snapshot: in its own leaves, unless their shapes are others, or `anew`."""
        parameters = model.parameters()
        # A GPU sums blend weights in any order, so that merging again may leave other splats than a saved run has, or room for other bands.
        if anew or any(tensor.shape != self.rows[name].shape for name, tensor in parameters.items()):
            copies = neighbors(self.rows)  # of colors, which are most of the memory
            copies |= {name: tensor.clone() for name, tensor in self.rows.items() if copies[name] is tensor}
            contract.replace_parameters(model, {name: tensor.requires_grad_() for name, tensor in copies.items()})
        else:
            for name, tensor in parameters.items():
                tensor.copy_(self.rows[name])
        for name, tensor in model.shared_parameters().items():
            tensor.copy_(self.shared[name])

    def to(self, device: torch.device) -> Snapshot:
        """The snapshot on another device."""
        rows, shared = ({name: tensor.to(device) for name, tensor in group.items()} for group in (self.rows, self.shared))
        return Snapshot(rows, shared, self.rows_changed)
