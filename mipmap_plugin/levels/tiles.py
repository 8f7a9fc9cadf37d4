"""3D Tiles for Cesium and others: a tile for each level, of which the coarser is replaced by the finer where its error would be visible.

A tile is replaced when its geometric error, seen from the camera, has more than 16 px (Cesium's `maximumScreenSpaceError`). A level should
be replaced at the zoom z of its switch, at which a base pixel of size p is 1 / z times as large as a pixel: its error is 16 · p / z.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.formats.atomic import new_folder, write_json
from mipmap_plugin.formats.splat_transform import convert
from mipmap_plugin.levels.manifest import read_manifest
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.wrap import wrap_model

TILES, TILESET = "tiles", "tileset.json"

# px: Cesium's default.
SCREEN_ERROR = 16

# A point (x, y, z) of a PLY lies at (-x, -z, -y) of a tile: splat-transform turns PLYs by half a turn about z on their way to glTF, whose y is up,
# and 3D Tiles, whose z is up, read a glTF's (x, y, z) as (x, -z, y).
AXES = (0, 2, 1)

# Standard deviations at which a splat ends, for bounding boxes.
REACH = 3.0


def errors(manifest: dict[str, Any]) -> list[float]:
    """The geometric error of each level in world units, from the finest, whose error is 0."""
    return [0.0, *(SCREEN_ERROR * manifest["base_pixel"] / switch["zoom"] for switch in manifest["switches"])]


def tileset(manifest: dict[str, Any], box: list[float]) -> dict[str, Any]:
    """The tileset of a ladder within `box`, whose levels are level_0.glb, level_1.glb, ..."""
    tile: dict[str, Any] = {}
    for number, error in enumerate(errors(manifest)):
        content = {"uri": f"level_{number}.glb"}
        finer = {"children": [tile]} if tile else {}
        tile = {"boundingVolume": {"box": box}, "geometricError": error, "refine": "REPLACE", "content": content, **finer}
    # Beyond this error nothing would be shown; the coarsest level is shown from any distance.
    farthest = 1e9 * max(1.0, tile["geometricError"])
    return {"asset": {"version": "1.1"}, "geometricError": farthest, "root": tile}


def bounding_box(model: SplatModel) -> list[float]:
    """The box around all splats as 3D Tiles write it: its center, then half of each of its three axes."""
    splats = model.gaussians(wrap_model(model).any_camera()).detach()
    reach: Tensor = REACH * splats.scales.max(dim=1).values[:, None]
    low, high = (splats.means - reach).amin(dim=0), (splats.means + reach).amax(dim=0)
    center, half = (each[list(AXES)] for each in ((low + high) / -2, (high - low) / 2))
    return [*center.tolist(), *torch.diag(half).flatten().tolist()]


def write_tiles(folder: Path, *, overwrite: bool = False) -> Path:
    """Write 3D Tiles to the subfolder `tiles` of a ladder; return its tileset.json.

    Raises SettingsError without splat-transform, OutputExists, OutputError.
    """
    manifest = read_manifest(folder)
    box = bounding_box(load_model(folder / manifest["levels"][0]["file"]))
    with new_folder(folder / TILES, overwrite) as temporary:
        for number, level in enumerate(manifest["levels"]):
            convert([folder / level["file"]], temporary / f"level_{number}.glb")
        write_json(temporary / TILESET, tileset(manifest, box), overwrite=False)
    return folder / TILES / TILESET
