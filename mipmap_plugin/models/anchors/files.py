"""Files of an anchor model: conversion between the columns of its PLY and raw parameters, and its companion files."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.errors import CheckpointError, OutputExists, SettingsError, some_of, warn
from mipmap_plugin.formats.atomic import new_file, sha256
from mipmap_plugin.formats.cfg_args import cfg_args_text, format_cfg_args
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.models.anchors.networks import Weights, check_networks, read_networks
from mipmap_plugin.models.base import CARRIED, TrainedScale
from mipmap_plugin.models.columns import NORMAL, POSITION, QUATERNION, numbered, stacked
from mipmap_plugin.models.detect import detect_as
from mipmap_plugin.models.health import LARGEST, dropped
from mipmap_plugin.models.inria_folder import read_options, trained_scale, usual_options
from mipmap_plugin.models.vanilla import Origin

OFFSET, FEATURE = "f_offset_", "f_anchor_feat_"

# Carried columns that a family reads: those of Octree-GS.
LEVELS = ("level", "extra_level")

# The first three scale an anchor's offsets, the others its splats.
SCALES = tuple(f"scale_{i}" for i in range(6))


@dataclass(frozen=True, eq=False)
class AnchorFile:
    """The contents of the PLY, its companions and its folder, or of a live object."""

    parameters: dict[str, Tensor]  # of the finite anchors
    carried: tuple[str, ...]  # the names of the columns in `parameters[CARRIED]`
    weights: Weights
    companions: dict[str, bytes]  # the files that the weights were read from
    options: dict[str, Any]  # of cfg_args
    trained: TrainedScale
    origin: Origin
    first: dict[str, np.ndarray] = field(default_factory=dict)  # the first two values of each column; Octree-GS keeps constants there
    notes: tuple[str, ...] = ()


def read_anchors(path: str | Path, family: str, iteration: int | None) -> AnchorFile:
    """Read the anchors at `path`, a PLY or model folder of `family`. Anchors that are not finite are dropped, with a note.

    Raises CheckpointError for a path that is damaged, incomplete, or of another family.
    """
    checkpoint = detect_as(path, (family,), iteration=iteration)
    ply = read_ply(checkpoint.path)
    parameters, carried = to_parameters(ply.columns, checkpoint.path)
    weights, companions = read_networks(checkpoint.path.parent)
    parameters, dropped = _checked(parameters, carried, weights, checkpoint.path)
    first = {name: column[:2].copy() for name, column in ply.columns.items()}
    options, notes = read_options(checkpoint.folder)
    digest = sha256(checkpoint.path, *(checkpoint.path.parent / name for name in companions))
    origin = Origin(checkpoint.path, digest, checkpoint.folder, checkpoint.iteration, ply.comments)
    every_note = (*checkpoint.notes, *ply.notes, *notes, *dropped, *_rounded(ply.columns, carried, checkpoint.path))
    return AnchorFile(parameters, carried, weights, companions, options, trained_scale(options), origin, first, every_note)


def anchors_in_memory(parameters: dict[str, Tensor], carried: tuple[str, ...], weights: Weights, name: str) -> AnchorFile:
    """As `read_anchors`, but from tensors of the live object `name`. Raises CheckpointError."""
    parameters, dropped = _checked(parameters, carried, weights, name)
    return AnchorFile(parameters, carried, weights, {}, {}, trained_scale({}), Origin(), notes=(f"copied from a live {name}", *dropped))


def to_parameters(columns: Mapping[str, np.ndarray], path: Path) -> tuple[dict[str, Tensor], tuple[str, ...]]:
    """Raw float32 parameters, and the names of the carried columns.

    means [N, 3], offsets [N, k, 3], features [N, F], scales [N, 6] log, carried [N, C]. Raises CheckpointError for missing columns.
    """
    offsets, features = numbered(columns, OFFSET), numbered(columns, FEATURE)
    missing = [name for name in (*POSITION, "opacity", *SCALES, *QUATERNION) if name not in columns]
    if missing or not features or not offsets or len(offsets) % 3:
        lacking = ", ".join(missing) or f"{len(offsets)} offsets and {len(features)} features do not make anchors"
        raise CheckpointError(f"{path} is an incomplete anchor model, columns are missing: {lacking}; export it again")
    known = {*POSITION, *NORMAL, *offsets, *features, *SCALES, "info"}
    carried = tuple(name for name in columns if name not in known)
    return {
        "means": stacked(columns, POSITION),
        "offsets": stacked(columns, offsets).unflatten(1, (3, -1)).transpose(1, 2).contiguous(),  # the file is channel-major
        "features": stacked(columns, features),
        "scales": stacked(columns, SCALES),
        CARRIED: stacked(columns, carried),
    }, carried


def to_columns(parameters: Mapping[str, Tensor], read: AnchorFile, second: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns in the original's order, all f4 but integers of the file that was `read`; those of `second` follow the position."""
    carried = read.carried
    raw = {name: tensor.detach().to("cpu", torch.float32) for name, tensor in parameters.items()}
    blocks = {OFFSET: raw["offsets"].transpose(1, 2).flatten(1), FEATURE: raw["features"]}
    named = {f"{prefix}{i}": block[:, i].numpy() for prefix, block in blocks.items() for i in range(block.shape[1])}
    middle = tuple(named)
    for names, block in ((POSITION, raw["means"]), (SCALES, raw["scales"]), (carried, raw[CARRIED])):
        named |= {name: block[:, i].numpy() for i, name in enumerate(names)}
    named |= second
    named |= {name: _as_integers(named[name], first.dtype) for name, first in read.first.items() if name in carried and first.dtype.kind in "iu"}
    order = dict.fromkeys((*POSITION, *second, *middle, "opacity", *SCALES, *QUATERNION, *carried))
    return {name: named[name] for name in order}


def _as_integers(column: np.ndarray, kind: np.dtype) -> np.ndarray:
    """A column [N] of float32 in an integer type of a file, as near as this has it."""
    limits = np.iinfo(kind)
    return column.astype(np.float64).clip(limits.min, limits.max).astype(kind.newbyteorder("="))


def _rounded(columns: Mapping[str, np.ndarray], carried: tuple[str, ...], path: Path) -> list[str]:
    """A note, which is also a warning, on integers that float32, which holds the carried columns, does not."""
    integers = [name for name in carried if columns[name].dtype.kind in "iu"]
    names = [name for name in integers if (columns[name] != columns[name].astype(np.float32).astype(np.float64)).any()]
    if not names:
        return []
    note = f"integers above {1 << np.finfo(np.float32).nmant + 1:,} in {', '.join(names)} are rounded to float32; number them from 0 if they matter"
    warn(f"{path}: {note}")
    return [note]


def write_beside(ply: Path, companions: Mapping[str, bytes], source: Path | None, overwrite: bool) -> None:
    """Write the networks' files, whose names are fixed, beside a PLY. Raises OutputExists if networks of other anchors would be replaced."""
    differ = refuse_others(ply, companions, source, overwrite)
    for name, content in companions.items():
        if name in differ or not (ply.parent / name).exists():
            with new_file(ply.parent / name, overwrite) as temporary:
                temporary.write_bytes(content)


def refuse_others(ply: Path, companions: Mapping[str, bytes], source: Path | None, overwrite: bool) -> list[str]:
    """The files beside `ply` that differ from `companions`. Raises OutputExists if they may not be replaced."""
    differ = [name for name, content in companions.items() if (ply.parent / name).exists() and (ply.parent / name).read_bytes() != content]
    if differ and (not overwrite or (source is not None and os.path.realpath(source.parent) == os.path.realpath(ply.parent))):
        raise OutputExists(f"{ply.parent} holds other networks ({', '.join(differ)}) that would be replaced; choose an empty folder")
    return differ


def cfg_text(source: Path | None, target: Path, trained: TrainedScale, options: dict[str, Any]) -> str:
    """The source's own cfg_args; if there is none, the original's usual options and those that follow from the files."""
    if source is not None and (source / "cfg_args").is_file():
        return cfg_args_text(source / "cfg_args")
    sampling = {"ds": 1, "ratio": 1, "undistorted": False, "white_background": trained.background == (1.0, 1.0, 1.0)}
    return format_cfg_args({**usual_options(target, trained), **sampling, **options})


def needs_views(views: Any) -> None:
    """Raise SettingsError without views: anchors have no splats without a camera."""
    if not views:
        raise SettingsError("the splats of anchors exist only for a camera; give at least one view")


def _checked(parameters: dict[str, Tensor], carried: tuple[str, ...], weights: Weights, where: Path | str) -> tuple[dict[str, Tensor], list[str]]:
    """The anchors that are finite and at most LARGEST once activated, and a note if some were dropped; columns that no family reads do not count.

    Raises CheckpointError if the networks do not fit the anchors, or if no anchor is left.
    """
    folder = where.parent if isinstance(where, Path) else where
    check_networks(weights, parameters["features"].shape[1], parameters["offsets"].shape[1], folder)
    read = [number for number, name in enumerate(carried) if name in LEVELS]
    values = [*(parameters | {CARRIED: parameters[CARRIED][:, read]}).values(), parameters["scales"].exp()]
    valid = torch.stack([(value.flatten(1).abs() <= LARGEST).all(1) for value in values]).all(0)  # False for NaN
    if valid.all():
        return parameters, []
    if not valid.any():
        raise CheckpointError(f"{where}: {some_of(0, len(valid), 'anchor', 'are')} finite; the training or the export failed")
    return {name: tensor[valid] for name, tensor in parameters.items()}, [dropped(~valid, "anchor", "not finite", where)]
