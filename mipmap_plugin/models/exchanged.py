"""Splats in an exchange format: converted to PLY by splat-transform when read, and back when written, except to SOG."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.splat_transform import EXCHANGE, as_ply
from mipmap_plugin.models.columns import OPACITY_MARGIN
from mipmap_plugin.models.detect import detect, detect_as
from mipmap_plugin.models.families import find_family
from mipmap_plugin.models.family import Files
from mipmap_plugin.models.reading import read_splats
from mipmap_plugin.models.vanilla import VanillaModel


def load_exchanged(path: str | Path, *, iteration: int | None = None) -> VanillaModel:
    """Load an SPZ, SOG (a file or a folder), KSPLAT, SPLAT or compressed PLY. Raises CheckpointError."""
    file = detect_as(path, ("exchange",), iteration=iteration).path
    files = Files(file)
    kind = "compressed" if files.compressed else files.kind
    with as_ply(file, kind) as ply:
        checkpoint = detect(ply)
        if checkpoint.family != "3dgs":
            raise CheckpointError(f"{file}: its splats are of {find_family(checkpoint.family).title}, not read from this format; give its own file")
        model = read_splats(replace(checkpoint, folder=None), VanillaModel).with_source(file)
    largest = torch.tensor(OPACITY_MARGIN).logit().abs().item()
    model.parameters()["opacities"].clamp_(-largest, largest)  # 8-bit opacities may be 0 or 1, whose logits are infinite
    rounding = f"{EXCHANGE[kind][0]} rounds the trained values: the base is what its viewers show"
    model.notes = [f"read through splat-transform; {rounding}", *(note for note in model.notes if ply.name not in note)]
    return model
