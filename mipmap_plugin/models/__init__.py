"""Models: checkpoints of any family, recognized by their content. Recognizing one imports no torch; its contract and loading it do."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mipmap_plugin.models  # through which annotations that are evaluated find SplatModel, without importing it before
from mipmap_plugin.errors import CheckpointError, MipmapPluginError, PluginError, type_of, with_type
from mipmap_plugin.limits import path_of
from mipmap_plugin.models.detect import Checkpoint, detect
from mipmap_plugin.models.families import BUILT_IN, FAMILIES, find_family, not_loaded
from mipmap_plugin.models.family import API_VERSION, BY_COMPANIONS, CERTAIN, PLAIN, Family, Files, Match
from mipmap_plugin.models.zipped_folder import retold, unzipped, with_archives_named
from mipmap_plugin.plugin_errors import is_third_party
from mipmap_plugin.registry import load_target

if TYPE_CHECKING:
    from mipmap_plugin.models.base import SplatModel, TrainedScale, Traits

__all__ = [
    "API_VERSION", "BY_COMPANIONS", "CERTAIN", "PLAIN", "Checkpoint", "Family", "Files", "Match", "SplatModel", "TrainedScale", "Traits", "detect",
    "load_model", "register_model",
]  # fmt: skip

# Of a float32, which all backends draw.
BYTES = 4

# Names from `base`, which is imported when one of them is first used.
_OF_BASE = ("SplatModel", "TrainedScale", "Traits")


def __getattr__(name: str) -> Any:
    if name not in _OF_BASE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.base"), name)


def load_model(path: str | Path, *, iteration: int | None = None) -> mipmap_plugin.models.SplatModel:
    """Load a checkpoint: a PLY, or a model folder (its newest complete iteration, or `iteration`).

    Raises CheckpointError for a path that is missing, damaged, not a checkpoint, or of a family that is not loaded; PluginError if a
    third-party loader cannot be imported, fails, or returns an object that is not a model.
    """
    checkpoint = detect(path, iteration=iteration)
    path = path_of(path)
    if (folder := unzipped(path)) != path:
        with retold(with_archives_named):
            return load_model(folder, iteration=iteration)
    from mipmap_plugin.models.contract import lacking
    from mipmap_plugin.process.torch_modes import usual_modes

    family = find_family(checkpoint.family)
    if family.load is None:
        raise CheckpointError(f"{checkpoint.path}: {not_loaded(checkpoint.family)}")
    load = load_target(family.name, family.load) if isinstance(family.load, str) else family.load
    try:
        with usual_modes():
            model: SplatModel = load(path, iteration=iteration)
    except (MipmapPluginError, MemoryError):
        raise
    except (Exception, SystemExit) as error:  # third-party code may fail in any way
        if family in BUILT_IN:
            raise
        raise PluginError(f"family {family.name!r} cannot load {checkpoint.path}: {with_type(error)}") from error
    if not hasattr(model, "gaussians"):  # it was not meant to be a model
        mend = "an object with the methods of mipmap_plugin.models.SplatModel, such as VanillaModel, which from_gaussians makes of Gaussians"
        raise PluginError(f"family {family.name!r}: its load has to return {mend}; it returned {type_of(model)}")
    if missing := lacking(model):
        raise PluginError(f"family {family.name!r} loads {type(model).__name__}, which lacks {', '.join(missing)}; see mipmap_plugin.models.base")
    if is_third_party(model) and model.family != family.name:
        raise PluginError(f"family {family.name!r} loads {type(model).__name__}, whose `family` is {model.family!r}; set it to {family.name!r}")
    if family not in BUILT_IN and any(tensor.element_size() > BYTES and tensor.is_floating_point() for tensor in model.parameters().values()):
        model.notes.append(f"family {family.name!r} loads float64, which only the slow backend reference draws; its load should return float32")
    return model


def register_model(name: str, target: Any, replace: bool = False) -> None:
    """Register a family: a `Family` with that name, or "package.module:FAMILY". Raises SettingsError if the name is taken."""
    FAMILIES.add(name, target, replace=replace)
