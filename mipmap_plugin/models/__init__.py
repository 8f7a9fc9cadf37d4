"""Models: checkpoints of any family, loaded by what they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.models.base import SplatModel, TrainedScale
from mipmap_plugin.models.detect import Checkpoint, detect, not_loaded
from mipmap_plugin.registry import Registry

__all__ = ["MODELS", "Checkpoint", "SplatModel", "TrainedScale", "detect", "load_model", "register_model"]

# By family (`detect.FAMILIES`): a function that loads the path of a PLY or model folder, `(path, *, iteration) -> SplatModel`.
MODELS = Registry(
    "mipmap_plugin.models",
    {
        "3dgs": "mipmap_plugin.models.vanilla:load_vanilla",
        **dict.fromkeys(("mip", "gof", "analytic"), "mipmap_plugin.models.mip:load_mip"),
        "2dgs": "mipmap_plugin.models.surfels:load_surfels",
        "deformable": "mipmap_plugin.models.deformable:load_deformable",
        "4dgs": "mipmap_plugin.models.hexplane:load_hexplane",
        "gsplat": "mipmap_plugin.models.gsplat:load_gsplat",
        "splatfacto": "mipmap_plugin.models.splatfacto:load_splatfacto",
        "scaffold": "mipmap_plugin.models.scaffold:load_scaffold",
        "exchange": "mipmap_plugin.models.exchanged:load_exchanged",
        "octree": "mipmap_plugin.models.octree:load_octree",
    },
)


def load_model(path: str | Path, *, iteration: int | None = None) -> SplatModel:
    """Load a checkpoint: a PLY, or a model folder (of its iterations the newest whole one, or `iteration`).

    Raises CheckpointError for what is missing, damaged, no checkpoint, or of a family that nothing is registered for.
    """
    found = detect(path, iteration=iteration)
    if found.family not in MODELS.names():
        raise CheckpointError(f"{found.path}: {not_loaded(found.family)}")
    return MODELS.get(found.family)(path, iteration=iteration)


def register_model(name: str, target: Any, replace: bool = False) -> None:
    """Load checkpoints of the family `name` with `target`, a function or "package.module:function". Raises SettingsError."""
    MODELS.add(name, target, replace=replace)
