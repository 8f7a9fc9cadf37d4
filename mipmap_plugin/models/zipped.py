"""Splats in a PLY in a zip archive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.ply import read_header
from mipmap_plugin.formats.tags import provenance_of
from mipmap_plugin.formats.zipped import unpacked
from mipmap_plugin.models.detect import detect
from mipmap_plugin.models.families import find_family
from mipmap_plugin.models.reading import read_splats
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.models.zipped_folder import retold


def load_zipped(path: str | Path, *, iteration: int | None = None) -> VanillaModel:
    """Load the 3DGS PLY in a zip archive that holds nothing else. Raises CheckpointError."""
    file = detect(path, iteration=iteration).path
    with unpacked(file) as ply, retold(lambda words: str(words).replace(str(ply), f"the PLY in {file}")):  # and not of the temporary one
        return _load(ply, file).with_source(file)


def _load(ply: Path, file: Path) -> VanillaModel:
    checkpoint = detect(ply)
    if checkpoint.family != "3dgs":
        raise CheckpointError(f"{file} holds a PLY of {find_family(checkpoint.family).title}; unpack it and give that")
    if "scale" in (provenance_of(read_header(ply).comments) or {}):
        raise CheckpointError(f"{file} holds a file that was adapted; unpack it, so that its scale is read too")
    return read_splats(replace(checkpoint, folder=None), VanillaModel)
