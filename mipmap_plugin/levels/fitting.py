"""One file of a chosen size: how many splats it may have, and the zoom that so many suit."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.splat_transform import WRITTEN
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.recipes import scale_of_fraction

UNITS = {"": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 2**10, "mib": 2**20, "gib": 2**30}
SIZE = re.compile(r"([0-9.]+)\s*([a-z]*)", re.IGNORECASE)

# Compressed files have a few percent more bytes per splat where splats are fewer.
COMPRESSED_MARGIN = 0.9

# Bytes kept for a PLY's header with its provenance, which does not grow with the splats.
HEADER = 8192

ENDINGS = (*WRITTEN, ".ply")


def read_size(text: str) -> int:
    """The bytes of a size such as 20MB, 1.5 GB or 4000000. Raises SettingsError."""
    found = SIZE.fullmatch(text.strip())
    try:
        size = int(float(found[1]) * UNITS[found[2].lower()]) if found else 0
    except (ValueError, KeyError, OverflowError):
        size = 0
    if size < 1:
        raise SettingsError(f"bytes: must be a size such as 20MB, got {text}")
    return size


def splats_within(model: SplatModel, size: int, name: str) -> int:
    """How many splats of the model fit into `size` bytes of a file of that name, judged by the model's own splats in that format.

    A model folder counts as the file of its splats. Raises SettingsError if not one splat fits, and what saving raises.
    """
    count = len(model.parameters()["means"])
    ending = next((each for each in ENDINGS if name.lower().endswith(each)), "")
    with tempfile.TemporaryDirectory(prefix="mipmap-plugin-") as folder:
        own = model.save(Path(folder, f"all{ending}"), provenance={}).stat().st_size
    fitting = int((COMPRESSED_MARGIN * size if ending in WRITTEN else size - HEADER) * count / own)
    if fitting < 1:
        raise SettingsError(f"bytes: {size:,} bytes hold no splat of this checkpoint and a header; allow more")
    return min(count, fitting)


def fitting_scale(splats: int, model: SplatModel) -> float:
    """The zoom that so many splats suit: the one at which the default recipe keeps as many of the model's; at most x1."""
    return scale_of_fraction(splats / len(model.parameters()["means"]))
