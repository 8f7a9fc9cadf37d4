"""Models: checkpoints of any family, recognized by their content."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mipmap_plugin.errors import CheckpointError, MipmapPluginError, PluginError
from mipmap_plugin.models.base import SplatModel, TrainedScale, Traits, lacking
from mipmap_plugin.models.detect import Checkpoint, detect
from mipmap_plugin.models.families import BUILT_IN, FAMILIES, find_family, not_loaded
from mipmap_plugin.models.family import API_VERSION, BY_COMPANIONS, CERTAIN, PLAIN, Family, Files, Match
from mipmap_plugin.registry import load_target

__all__ = [
    "API_VERSION",
    "BY_COMPANIONS",
    "CERTAIN",
    "PLAIN",
    "Checkpoint",
    "Family",
    "Files",
    "Match",
    "SplatModel",
    "TrainedScale",
    "Traits",
    "detect",
    "load_model",
    "register_model",
]  # fmt: skip


def load_model(path: str | Path, *, iteration: int | None = None) -> SplatModel:
    """Load a checkpoint: a PLY, or a model folder (its newest complete iteration, or `iteration`).

    Raises CheckpointError for a path that is missing, damaged, not a checkpoint, or of a family that is not loaded; PluginError if a
    third-party loader cannot be imported, fails, or returns an object that is not a model.
    """
    checkpoint = detect(path, iteration=iteration)
    family = find_family(checkpoint.family)
    if family.load is None:
        raise CheckpointError(f"{checkpoint.path}: {not_loaded(checkpoint.family)}")
    load = load_target(family.name, family.load) if isinstance(family.load, str) else family.load
    try:
        model: SplatModel = load(path, iteration=iteration)
    except (MipmapPluginError, OSError, MemoryError):
        raise
    except Exception as error:  # third-party code may fail in any way
        if family in BUILT_IN:
            raise
        raise PluginError(f"family {family.name!r} cannot load {checkpoint.path}: {type(error).__name__}: {error}") from error
    if missing := lacking(model):
        raise PluginError(f"family {family.name!r} loads {type(model).__name__}, which lacks {', '.join(missing)}; see mipmap_plugin.models.base")
    return model


def register_model(name: str, target: Any, replace: bool = False) -> None:
    """Register a family: a `Family` with that name, or "package.module:FAMILY". Raises SettingsError if the name is taken."""
    FAMILIES.add(name, target, replace=replace)
