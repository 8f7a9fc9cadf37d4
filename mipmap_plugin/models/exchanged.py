"""Splats in a file that a temporary PLY is made of: an exchange format, which splat-transform converts, or a zip archive of one PLY."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.ply import read_header
from mipmap_plugin.formats.splat_transform import EXCHANGE, TOOL, as_ply
from mipmap_plugin.formats.tags import provenance_of
from mipmap_plugin.formats.zipped import unpacked
from mipmap_plugin.models.columns import OPACITY_MARGIN
from mipmap_plugin.models.detect import detect, detect_as
from mipmap_plugin.models.families import find_family
from mipmap_plugin.models.family import Files
from mipmap_plugin.models.reading import read_splats
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.models.zipped_folder import retold


def load_exchanged(path: str | Path, *, iteration: int | None = None) -> VanillaModel:
    """Load an SPZ, SOG (a file or a folder), KSPLAT, SPLAT or compressed PLY. Raises CheckpointError."""
    file = detect_as(path, ("exchange",), iteration=iteration).path
    files = Files(file)
    kind = "compressed" if files.compressed else files.kind
    with as_ply(file, kind) as ply, retold(lambda words: str(words).replace(str(ply), f"{file}, as {TOOL} reads it")):
        model = _read(ply, file, "{file}: its splats are of {title}, not read from this format; give its own file")
    largest = torch.tensor(OPACITY_MARGIN).logit().abs().item()
    model.parameters()["opacities"].clamp_(-largest, largest)  # 8-bit opacities may be 0 or 1, whose logits are infinite
    rounding = f"{EXCHANGE[kind][0]} rounds the trained values: the base is what its viewers show"
    model.notes = [f"read through splat-transform; {rounding}", *(note for note in model.notes if ply.name not in note)]
    return model


def load_zipped(path: str | Path, *, iteration: int | None = None) -> VanillaModel:
    """Load the 3DGS PLY in a zip archive that holds nothing else. Raises CheckpointError."""
    file = detect(path, iteration=iteration).path
    with unpacked(file) as ply, retold(lambda words: str(words).replace(str(ply), f"the PLY in {file}")):  # and not of the temporary one
        model = _read(ply, file, "{file} holds a PLY of {title}; unpack it and give that")
        if "scale" in (provenance_of(read_header(ply).comments) or {}):
            raise CheckpointError(f"{file} holds a file that was adapted; unpack it, so that its scale is read too")
    return model


def _read(ply: Path, file: Path, refusal: str) -> VanillaModel:
    """The splats of the temporary `ply`, as those of `file`. Raises CheckpointError, with the words `refusal`, for a family other than 3DGS."""
    checkpoint = detect(ply)
    if checkpoint.family != "3dgs":
        raise CheckpointError(refusal.format(file=file, title=find_family(checkpoint.family).title))
    return read_splats(replace(checkpoint, folder=None), VanillaModel).with_source(file)
