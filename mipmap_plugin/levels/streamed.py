"""Streamed SOG, which PlayCanvas, SuperSplat and Babylon.js load piece by piece: the levels through splat-transform, and when to show which.

PlayCanvas shows a chunk by its distance, multiplied by the smaller tangent of half a field of view over the tangent of 22.5°: level 0 up
to `lodBaseDistance`, level k up to `lodBaseDistance · lodMultiplier^k`. On a canvas that is H px along that side, such a distance d is seen
with (H / 2) / (d · tan 22.5°) px per world unit. A base pixel of size p, seen at the zoom z, has z / p.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.atomic import new_folder, write_json
from mipmap_plugin.formats.splat_transform import convert
from mipmap_plugin.levels.manifest import read_manifest

STREAMED, SETTINGS = "streamed", "playcanvas.json"

# px: the shorter side of the canvas that distances are computed for.
CANVAS = 1080


def distances(manifest: dict[str, Any], canvas: int = CANVAS) -> list[float]:
    """The distances of PlayCanvas's rule, in world units, at which the levels of a ladder should be switched, rising."""
    return [canvas / 2 * manifest["base_pixel"] / (math.tan(math.pi / 8) * switch["zoom"]) for switch in manifest["switches"]]


def progression(rising: Sequence[float], ratio: float) -> tuple[float, float]:
    """`lodBaseDistance` and `lodMultiplier`: the geometric progression closest to the distances, by least squares of logarithms.

    `ratio`: the multiplier where there is only one distance.
    """
    logs = [math.log(distance) for distance in rising]
    middle = (len(logs) - 1) / 2
    spread = sum((number - middle) ** 2 for number in range(len(logs)))
    slope = sum((number - middle) * log for number, log in enumerate(logs)) / spread if spread else math.log(ratio)
    return math.exp(fmean(logs) - slope * middle), math.exp(slope)


def viewer_settings(manifest: dict[str, Any], canvas: int = CANVAS) -> dict[str, Any]:
    """What a page has to set on its PlayCanvas splat component. Raises SettingsError for a single level."""
    rising = distances(manifest, canvas)
    if not rising:
        raise SettingsError("this ladder has a single level, which needs no streaming; give a smaller --coarsest")
    scales = [level["scale"] for level in manifest["levels"]]
    base, multiplier = progression(rising, scales[0] / scales[1])
    return {
        "lodBaseDistance": base,
        "lodMultiplier": multiplier,
        "splatBudgetMode": "limit",  # the default slides the distances until a number of splats is shown
        "canvas": canvas,
        "distances": rising,
    }


def tool_inputs(folder: Path, manifest: dict[str, Any]) -> list[str]:
    """The inputs of splat-transform: each file with its level."""
    return [word for number, level in enumerate(manifest["levels"]) for word in (str(folder / level["file"]), "--lod", str(number))]


def write_streamed(folder: Path, canvas: int = CANVAS, *, overwrite: bool = False) -> Path:
    """Write Streamed SOG and the viewer's settings to the subfolder `streamed` of a ladder; return its lod-meta.json.

    Raises SettingsError without splat-transform, OutputExists, OutputError.
    """
    manifest = read_manifest(folder)
    settings = viewer_settings(manifest, canvas)
    with new_folder(folder / STREAMED, overwrite) as temporary:
        convert(tool_inputs(folder, manifest), temporary / "lod-meta.json")
        write_json(temporary / SETTINGS, settings, overwrite=False)
    return folder / STREAMED / "lod-meta.json"
