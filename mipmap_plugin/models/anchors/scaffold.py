"""Scaffold-GS (Lu et al. 2024): anchors on a voxel grid whose splats are decoded for each view."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from mipmap_plugin.models.anchors.files import AnchorFile, anchors_in_memory, read_anchors
from mipmap_plugin.models.anchors.model import AnchorModel
from mipmap_plugin.models.anchors.networks import Weights, inputs_of
from mipmap_plugin.models.columns import NORMAL, QUATERNION


class ScaffoldModel(AnchorModel):
    """Anchors without levels of detail."""

    family = "scaffold"

    def _second_columns(self) -> dict[str, np.ndarray]:
        return {name: np.zeros(len(self), np.float32) for name in NORMAL}

    def _cfg_options(self) -> dict[str, Any]:
        growth = {"voxel_size": 0.001, "update_depth": 3, "update_init_factor": 16, "update_hierachy_factor": 4}  # the original spells it so
        return {"sh_degree": 3, **growth, "lod": 0, "lowpoly": False, **super()._cfg_options()}


def load_scaffold(path: str | Path, *, iteration: int | None = None) -> ScaffoldModel:
    """Load a Scaffold-GS model folder, or its PLY with the networks beside it.

    Which networks take the distance of the camera follows from their shapes. Raises CheckpointError.
    """
    read = read_anchors(path, "scaffold", iteration)
    model = _model(read, read.origin.source)
    if read.options.get("eval") and (lod := read.options.get("lod")):
        model.notes.append(f"cfg_args says lod={lod}: its test views are the first or the last ones by name, not every eighth")
    return model


def scaffold_in_memory(parameters: dict[str, Tensor], weights: Weights, name: str) -> ScaffoldModel:
    """The model of raw tensors of the live object `name`, with opacity and quaternion in `carried`. Raises CheckpointError."""
    read = anchors_in_memory(parameters, ("opacity", *QUATERNION), weights, name)
    return _model(read, name)


def _model(read: AnchorFile, where: Path | str | None) -> ScaffoldModel:
    return ScaffoldModel(read, inputs_of(read.weights, read.parameters["features"].shape[1], ("direction", "distance"), where))
