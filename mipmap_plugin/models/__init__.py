"""Models: checkpoints of any family, loaded by what they are."""

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
    """Load a checkpoint: a PLY, or a model folder (of its iterations the newest whole one, or `iteration`).

    Raises CheckpointError for what is missing, damaged, no checkpoint, or of a family that is not loaded; PluginError where a
    stranger's loader cannot be imported or returns what is no model.
    """
    found = detect(path, iteration=iteration)
    family = find_family(found.family)
    if family.load is None:
        raise CheckpointError(f"{found.path}: {not_loaded(found.family)}")
    load = load_target(family.name, family.load) if isinstance(family.load, str) else family.load
    try:
        model = load(path, iteration=iteration)
    except (MipmapPluginError, OSError, MemoryError):
        raise
    except Exception as error:  # a stranger's code may fail in any way
        if family in BUILT_IN:
            raise
        raise PluginError(f"family {family.name!r} cannot load {found.path}: {type(error).__name__}: {error}") from error
    if lacks := lacking(model):
        raise PluginError(f"family {family.name!r} loads {type(model).__name__}, which lacks {', '.join(lacks)}; see mipmap_plugin.models.base")
    return model


def register_model(name: str, target: Any, replace: bool = False) -> None:
    """Recognize and load the checkpoints of a family, a `Family` of that name or "package.module:FAMILY". Raises SettingsError."""
    FAMILIES.add(name, target, replace=replace)
