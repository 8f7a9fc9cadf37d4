"""3D Tiles for Cesium and others: a tile for each level, of which the coarser is replaced by the finer where its error would be visible.

A tile is replaced when its geometric error, seen from the nearest point of its box, has more than 16 px (Cesium's `maximumScreenSpaceError`). A
level should be replaced at the zoom z of its switch, at which a base pixel of size p is 1 / z times as large as a pixel: its error is 16 · p / z,
times the distance of the box over that of the splats. One box holds all splats, those far away too, so that it begins long before most of them.

A camera inside the box is at no distance from it, and would see the finest level wherever it stands. So where the box reaches around the
camera, each finer level has a `viewerRequestVolume` (3D Tiles 1.1): a sphere around the scene's middle, outside of which it is not shown.

Cesium draws the splats of a glTF only if they are SPZ, by KHR_gaussian_splatting_compression_spz_2, and only if the tileset requires both
extensions; it takes others for points, whose shader does not compile, and stops (1.145: GaussianSplat3DTileContent, GltfLoader). It also
wants a matrix, and no rotation, in the node.
"""

from __future__ import annotations

import gzip
import math
import shutil
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.camera import ONE_PIXEL
from mipmap_plugin.errors import TEMPORARY, warn
from mipmap_plugin.formats.atomic import new_folder, write_json
from mipmap_plugin.formats.glb import FLOAT, before_binary
from mipmap_plugin.formats.gltf import DISPLAY, SPLATTING, SPZ_INSIDE
from mipmap_plugin.formats.splat_transform import write_exchange
from mipmap_plugin.formats.spz import HEADER as SPZ_HEADER
from mipmap_plugin.levels.exported import readable
from mipmap_plugin.levels.manifest import CANVAS, read_manifest
from mipmap_plugin.levels.streamed import Approach, distances
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.models.outputs import cut_off, refuse_far

TILES, TILESET = "tiles", "tileset.json"

# px: Cesium's default.
SCREEN_ERROR = 16

# A camera of Cesium's own sees 60 degrees along the longer side, here of 16 x 9: how many times as far away it is where pixels are as large as those
# of a camera that sees 45 degrees along the shorter side.
LENS = math.tan(math.pi / 8) / (9 / 16 * math.tan(math.pi / 6))

# Of the distance from the scene's middle: a camera that is nearer to the box than this has the box around it, or nearly.
AROUND = 1 / 2

# A point (x, y, z) of a PLY lies at (-x, -z, -y) of a tile: the node turns it by half a turn about z, as glTF's y is up, and 3D Tiles, whose z is
# up, read a glTF's (x, y, z) as (x, -z, y).
AXES = (0, 2, 1)
HALF_TURN = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]

COMPRESSION = SPZ_INSIDE[0]
EXTENSIONS = {"extensionsUsed": [SPLATTING, COMPRESSION], "extensionsRequired": [SPLATTING, COMPRESSION]}

BYTE = 5121  # glTF 2.0's code of that type of numbers

# Standard deviations at which a splat ends, for bounding boxes.
REACH = 3.0


def errors(manifest: dict[str, Any], approach: Approach | None, canvas: int) -> list[float]:
    """The geometric error of each level in world units, from the finest, whose error is 0.

    `approach`: to the box of all levels; None for a ladder by distance, whose levels are made for distances from boxes. `canvas`: its shorter side in
    px, on which the camera's distance depends.
    """
    pixel = manifest["view_pixel" if approach else "base_pixel"]
    nearness = [1.0] * len(manifest["switches"])
    if approach and not _around(approach, away := _away(manifest, canvas)):
        nearness = [approach.chunk_distance(distance) / distance for distance in away]
    return [0.0, *(SCREEN_ERROR * pixel / switch["zoom"] * near for switch, near in zip(manifest["switches"], nearness, strict=True))]


def spheres(manifest: dict[str, Any], approach: Approach | None, canvas: int) -> list[list[float]]:
    """The spheres (x, y, z, radius) within which levels but the coarsest are shown, from the finest; none where `errors` are enough.

    Parameters as those of `errors`; in the axes of a tile, world units.
    """
    if approach is None or not _around(approach, away := _away(manifest, canvas)):
        return []
    middle = [-manifest["middle"][axis] for axis in AXES]
    return [[*middle, distance] for distance in away]


def _away(manifest: dict[str, Any], canvas: int) -> list[float]:
    """The distances from the scene's middle at which levels should be switched before a camera of Cesium's own, world units, rising."""
    return [LENS * distance for distance in distances(manifest, canvas, "view_pixel")]


def _around(approach: Approach, away: Sequence[float]) -> bool:
    """Whether the box reaches around a camera that is so far away from the scene's middle."""
    return any(approach.chunk_distance(distance) < AROUND * distance for distance in away)


def tileset(box: list[float], errors: Sequence[float], spheres: Sequence[list[float]] = ()) -> dict[str, Any]:
    """The tileset of levels within `box` that have these errors, and of those that are shown within `spheres` only: level_0.glb, level_1.glb, ..."""
    # Of a tile whose box is within that of its parent Cesium takes the parent for invisible, too, where the tile is: not of spheres.
    volume = {"sphere": _sphere_around(box)} if spheres else {"box": box}
    tile: dict[str, Any] = {}
    for number, error in enumerate(errors):
        content = {"uri": f"level_{number}.glb"}
        finer = {"children": [tile]} if tile else {}
        shown = {"viewerRequestVolume": {"sphere": spheres[number]}} if number < len(spheres) else {}
        tile = {"boundingVolume": volume, **shown, "geometricError": error, "refine": "REPLACE", "content": content, **finer}
    # Beyond this error nothing would be shown; the coarsest level is shown from any distance.
    farthest = 1e9 * max(1.0, tile["geometricError"])
    said = {"extensionsUsed": ["3DTILES_content_gltf"], "extensions": {"3DTILES_content_gltf": EXTENSIONS}}
    return {"asset": {"version": "1.1"}, **said, "geometricError": farthest, "root": tile}


def bounds(levels: Iterable[SplatModel]) -> tuple[Tensor, Tensor]:
    """The lowest and the highest corner [3] of the box around all splats of all levels (merged ones reach farther)."""
    lows, highs = zip(*(_bounds(model) for model in levels), strict=True)
    return torch.stack(lows).amin(dim=0), torch.stack(highs).amax(dim=0)


def bounding_box(low: Tensor, high: Tensor) -> list[float]:
    """The box between two corners [3], as 3D Tiles write it: its center, then half of each of its axes."""
    center, half = (each[list(AXES)] for each in ((low + high) / -2, (high - low) / 2))
    return [*center.tolist(), *torch.diag(half).flatten().tolist()]


def _sphere_around(box: Sequence[float]) -> list[float]:
    """The sphere around such a box: its center, then its radius."""
    return [*box[:3], math.hypot(*box[3:])]


def _bounds(model: SplatModel) -> tuple[Tensor, Tensor]:
    """The least and the greatest coordinates of all splats, [3] each."""
    splats = model.gaussians(ONE_PIXEL).detach()
    beyond: Tensor = REACH * splats.scales.max(dim=1).values[:, None]
    return (splats.means - beyond).amin(dim=0), (splats.means + beyond).amax(dim=0)


def write_tile(ply: Path, tile: Path) -> None:
    """Write a GLB of the splats of a PLY. Raises SettingsError without splat-transform and for splats too far away, OutputError."""
    compressed, parameters = tile.with_suffix(".spz"), load_model(ply).parameters()
    means = parameters["means"].detach()
    if lost := cut_off(compressed, parameters):
        warn(f"{tile.name}: {lost}")
    refuse_far(tile, parameters, "open the level itself")
    with TemporaryDirectory(prefix=TEMPORARY) as folder:
        write_exchange(compressed, partial(shutil.copyfile, readable(ply, Path(folder, ply.name))), overwrite=False)
    tile.write_bytes(glb(compressed.read_bytes(), means.amin(dim=0).tolist(), means.amax(dim=0).tolist()))
    compressed.unlink()


def glb(spz: bytes, low: list[float], high: list[float]) -> bytes:
    """A binary glTF of splats in SPZ, whose centers lie between `low` and `high`. Accessors have no bytes of their own: SPZ has them all."""
    _, _, count, degree, *_ = SPZ_HEADER.unpack_from(gzip.decompress(spz))
    types = {"POSITION": "VEC3", "COLOR_0": "VEC4", f"{SPLATTING}:ROTATION": "VEC4", f"{SPLATTING}:SCALE": "VEC3"}
    types |= {f"{SPLATTING}:SH_DEGREE_{band}_COEF_{n}": "VEC3" for band in range(1, degree + 1) for n in range(2 * band + 1)}
    more: dict[str, dict[str, Any]] = {"POSITION": {"min": low, "max": high}, "COLOR_0": {"componentType": BYTE, "normalized": True}}
    accessors = [{"componentType": FLOAT, "count": count, "type": kind, **more.get(name, {})} for name, kind in types.items()]
    splats = {"kernel": "ellipse", "colorSpace": DISPLAY[0], "extensions": {COMPRESSION: {"bufferView": 0}}}
    primitive = {"mode": 0, "attributes": {name: i for i, name in enumerate(types)}, "extensions": {SPLATTING: splats}}
    document = {
        "asset": {"version": "2.0"}, **EXTENSIONS, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, "matrix": HALF_TURN}],
        "meshes": [{"primitives": [primitive]}], "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteLength": len(spz)}], "buffers": [{"byteLength": len(spz)}],
    }  # fmt: skip
    binary = spz + b"\0" * (-len(spz) % 4)
    return before_binary(document, len(binary)) + binary


def write_tiles(folder: Path, canvas: int = CANVAS) -> Path:
    """Write 3D Tiles to the subfolder `tiles` of a ladder; return its tileset.json. `canvas`: its shorter side in px.

    Raises SettingsError without splat-transform, OutputExists, OutputError.
    """
    manifest = read_manifest(folder)
    files = [folder / level["file"] for level in manifest["levels"]]
    low, high = bounds(map(load_model, files))
    approach = None if manifest.get("by") == "distance" else Approach.to_box(manifest["middle"], low, high)
    with new_folder(folder / TILES, overwrite=False) as temporary:
        for number, file in enumerate(files):
            write_tile(file, temporary / f"level_{number}.glb")
        made = tileset(bounding_box(low, high), errors(manifest, approach, canvas), spheres(manifest, approach, canvas))
        write_json(temporary / TILESET, made, overwrite=False)
    return folder / TILES / TILESET
