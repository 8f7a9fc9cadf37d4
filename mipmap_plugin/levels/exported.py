"""The PLY of a level as splat-transform reads it."""

from __future__ import annotations

from pathlib import Path

from mipmap_plugin.errors import warn
from mipmap_plugin.formats.ply import read_header
from mipmap_plugin.formats.splat_transform import MOST_BANDS, TOOL
from mipmap_plugin.models import load_model

LOST = f"SH bands above degree {MOST_BANDS} are dropped from what viewers stream, as {TOOL} does not read them; the levels' PLYs have them"


def readable(ply: Path, copy: Path) -> Path:
    """A PLY that splat-transform reads: `ply` itself, or `copy`, which is made of it without SH bands that it does not know, with a warning."""
    bands = (MOST_BANDS + 1) ** 2 - 1
    if sum(name.startswith("f_rest_") for name in read_header(ply).vertex.names) <= 3 * bands:
        return ply
    warn(LOST)
    model = load_model(ply).copy()
    parameters = {name: tensor.detach() for name, tensor in model.parameters().items()}
    model.replace_parameters(parameters | {"shN": parameters["shN"][:, :bands].contiguous()})
    return model.save(copy, provenance={})
