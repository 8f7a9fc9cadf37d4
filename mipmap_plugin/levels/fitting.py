"""One file of a chosen size: how many splats it may have, and the zoom that so many suit."""

from __future__ import annotations

import json
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from mipmap_plugin.adaptation.report import provenance
from mipmap_plugin.adaptation.target.upsamplers import network_input
from mipmap_plugin.errors import TEMPORARY, MipmapPluginError, SettingsError, plural
from mipmap_plugin.formats.glb import bytes_before_binary
from mipmap_plugin.formats.ply import read_header
from mipmap_plugin.formats.splat_transform import WRITTEN
from mipmap_plugin.frozen_base import FrozenBase
from mipmap_plugin.models import contract
from mipmap_plugin.models.base import SplatModel, digest_of_model
from mipmap_plugin.models.health import holds_splats
from mipmap_plugin.models.loaders import for_loader_of, wants_filter
from mipmap_plugin.process.versions import versions
from mipmap_plugin.recipes import recipe, scale_of_fraction
from mipmap_plugin.splatting.viewers import degree_for

# Compressed files have a few percent more bytes per splat after steps.
COMPRESSED_MARGIN = 0.9

# What moves values off the steps that they were rounded to in a compressed base: coefficients by up to two of SPZ's steps of 8 bits, others by up to
# this fraction. An adapted file is not rounded so, and compresses less: of an SPZ with 25 bytes a splat it has 33 to 44.
HARMONIC_STEP, UNROUNDED = 1 / 64, 0.01

# Bytes that the head of a PLY may have beyond what is known of it before the run: digits of the scale and of settings that follow from it, the name
# of the filter that fits, the hash of photographs, the tag of the viewer's filter and its dilation. All together they have 214 at most, those of a
# GLB's fewer (digits of its bounds, and how it is drawn), and a splat has 68 to 248.
UNKNOWN = 256

# Bytes kept for what a file of another project has besides its splats: a torch archive's own, and comments.
ARCHIVE = 8192

# A scale of as many digits as any, for settings that follow from a scale that is not chosen yet.
ANY_SCALE = 1 / 3

ENDINGS = (*WRITTEN, ".ply")

# Those of files that are compressed without loss in the end, so that their bytes depend on the values of the splats.
SQUEEZED = (".spz", ".sog")


def recorded(base: FrozenBase, requests: Sequence[tuple[float, str | None]], settings: Mapping[str, Any]) -> dict[str, Any]:
    """What the header of an adapted file will record, as far as it is known before the run; of several files, that of the largest.

    `requests`: scales and viewers, at least one. `settings`: those of `adapt`, with the recipe's name. Raises SettingsError for one that is
    unknown or out of range.
    """
    further = {**settings, "most_splats": len(base.model.parameters()["means"])}
    name, known = further.pop("recipe"), {"base": digest_of_model(base.model), "orbit": asdict(base.viewpoints.orbit)}

    def record(scale: float, viewer: str | None) -> dict[str, Any]:
        config = recipe(name, scale, **further)
        inputs = base.asked | network_input(config.upsampler)
        return provenance({"scale": scale, "viewer": viewer, "inputs": inputs, **known}, config, versions())

    records = [record(scale, viewer) for scale, viewer in requests]
    degree = getattr(base.model, "sh_degree", 0)
    return max(records, key=lambda of: (degree_for(of["viewer"], degree), wants_filter(of["viewer"]), len(json.dumps(of, default=str))))


def splats_within(model: SplatModel, size: int, name: str, record: dict[str, Any]) -> int:
    """How many splats of the model fit into `size` bytes of a file of that name, judged by the model's own splats in that format.

    `record`: what its header will record, as far as it is known. A model folder counts as the file of its splats. Raises SettingsError if not
    one splat fits, and what saving raises.
    """
    ending = next((each for each in ENDINGS if name.lower().endswith(each)), "")
    count = len(model.parameters()["means"])
    squeezed = ending in SQUEEZED and holds_splats(model)
    fitting = _fitting(_unrounded(model, count) if squeezed else model, size, name, ending, record)
    if squeezed and 0 < fitting < count:  # of fewer splats each takes more bytes, above all in SOG, where they share entries
        fitting = _fitting(_unrounded(model, fitting), size, name, ending, record)
    if fitting < 1:
        raise SettingsError(f"bytes: {plural(size, 'byte')} have no room for a header and a splat of this checkpoint; allow more")
    return min(count, fitting)


def _unrounded(model: SplatModel, count: int) -> SplatModel:
    """`count` of the splats, evenly, with values as an adapted file has them, which no format has rounded."""
    some, generator = model.copy(), torch.Generator().manual_seed(0)
    parameters = {name: values.detach() for name, values in some.parameters().items()}
    rows = torch.linspace(0, len(parameters["means"]) - 1, count, dtype=torch.float64).long()
    for name, values in parameters.items():
        noise = (2 * torch.rand(values[rows].shape, generator=generator) - 1).to(values)
        parameters[name] = values[rows] + noise * (HARMONIC_STEP if name == "shN" else UNROUNDED * values[rows])
    some.replace_parameters(parameters)
    return some


def _fitting(model: SplatModel, size: int, name: str, ending: str, record: dict[str, Any]) -> int:
    """How many splats fit into `size` bytes if all take as many as those of the model."""
    count = len(model.parameters()["means"])
    with tempfile.TemporaryDirectory(prefix=TEMPORARY) as folder:
        every = Path(folder, f"all{ending}" if ending else f"all_{name}")  # a third-party family may know its files by their ending
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what this format cannot hold is said of the file that is kept
                own = contract.save(for_loader_of(record.get("viewer"), model, every), every, record)
        except MipmapPluginError as error:
            raise type(error)(str(error).replace(str(every), name)) from error
        besides, all_of_them = _besides(own), own.stat().st_size
    if besides:
        return (size - besides - UNKNOWN) * count // (all_of_them - besides)
    return int((COMPRESSED_MARGIN * size if ending in SQUEEZED else size - ARCHIVE) * count / all_of_them)


def _besides(file: Path) -> int:
    """Bytes that a file has besides its splats, of which each takes as many; 0 if that is not known."""
    if file.suffix == ".ply":
        return read_header(file).body
    return bytes_before_binary(file) if file.suffix == ".glb" else 0


def fitting_scale(splats: int, model: SplatModel) -> float:
    """The zoom that so many splats suit: the one at which the default recipe keeps as many of the model's; at most x1."""
    return scale_of_fraction(splats / len(model.parameters()["means"]))
