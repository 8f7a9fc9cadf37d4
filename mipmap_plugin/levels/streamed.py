"""Streamed SOG, which PlayCanvas, SuperSplat and Babylon.js load piece by piece: the levels through splat-transform, and when to show which.

PlayCanvas shows a chunk by its distance, multiplied by the smaller tangent of half a field of view over the tangent of 22.5°: level 0 up
to `lodBaseDistance`, level k up to `lodBaseDistance · lodMultiplier^k`. On a canvas that is H px along that side, what such a distance d is
away is seen with (H / 2) / (d · tan 22.5°) px per world unit. A base pixel of size p, seen at the zoom z, has z / p.

The distance of a chunk is that to the nearest point of its box, of which `lodDistanceShrink` has taken most of what is larger than in half of
the chunks. It is closer than the splats, and how much depends on the boxes: a few splats far away make some boxes long. So it is measured, from
cameras that look at the scene from all around.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.errors import TEMPORARY, SettingsError, warn
from mipmap_plugin.formats.atomic import new_folder, write_json
from mipmap_plugin.formats.splat_transform import LOD_META
from mipmap_plugin.formats.streamed_sog import Chunk, read_chunks, write_streamed_sog
from mipmap_plugin.levels.distance.chunks import box_distances, shrunk
from mipmap_plugin.levels.exported import readable
from mipmap_plugin.levels.manifest import CANVAS, read_manifest
from mipmap_plugin.scenes.photographed import even_directions

STREAMED, SETTINGS = "streamed", "playcanvas.json"

SINGLE_LEVEL = "this ladder has a single level, which needs no streaming"

# The largest extent of a chunk, as a part of the distance of the first switch: its near and its far end are then seen at nearly one zoom.
EXTENT = 1 / 4

# Directions from which chunks are looked at, unit vectors [D, 3]; and the steps that find a distance to a millionth.
DIRECTIONS, HALVINGS = even_directions(64), 20

# The splats that PlayCanvas shows at most.
BUDGET = 1_000_000

# PlayCanvas's bounds of `lodBaseDistance`, in world units, and of `lodMultiplier`.
NEAREST, LEAST_MULTIPLIER = 0.1, 1.2

TOO_SMALL = "PlayCanvas changes no level nearer than {least:g} units, and level 0 should end at {first:.2g}: it stays too long; enlarge the scene"

# The part of the distance of the first switch that the camera moves before PlayCanvas looks again which levels to show; its own is 1 unit.
MOVED = 1 / 50


def distances(manifest: dict[str, Any], canvas: int, pixel: str = "base_pixel") -> list[float]:
    """The distances from splats, in world units and a field of view of 45°, at which the levels of a ladder should be switched, rising.

    `pixel`: the key of the manifest that says how large a base pixel is.
    """
    return [canvas / 2 * manifest[pixel] / (math.tan(math.pi / 8) * switch["zoom"]) for switch in manifest["switches"]]


@dataclass(frozen=True, eq=False)
class Approach:
    """How far away the boxes of a scene are when a camera looks at the scene's middle, from any direction: chunks, or a tile."""

    middle: Tensor  # [3] world units
    low: Tensor  # [C, 3], of the boxes that distances are measured to
    high: Tensor  # [C, 3]
    splats: Tensor  # [C], of the finest level

    @classmethod
    def to(cls, middle: Sequence[float], chunks: Sequence[Chunk]) -> Approach:
        """To the `middle` (x, y, z) of the finest level's splats, world units."""
        low, high = (torch.tensor([getattr(chunk, end) for chunk in chunks], dtype=torch.float64) for end in ("low", "high"))
        splats = torch.tensor([chunk.splats[0] for chunk in chunks], dtype=torch.float64)
        return cls(torch.tensor(middle, dtype=torch.float64), *shrunk(low, high), splats)

    @classmethod
    def to_box(cls, middle: Sequence[float], low: Tensor, high: Tensor) -> Approach:
        """To the `middle` (x, y, z) in a single box between two corners [3], world units."""
        return cls(torch.tensor(middle, dtype=torch.float64), low.double()[None], high.double()[None], torch.ones(1, dtype=torch.float64))

    def chunk_distance(self, distance: float) -> float:
        """The distance of the chunks from a camera so far from the middle, world units: the median over splats and directions."""
        eyes = self.middle + distance * DIRECTIONS
        away = box_distances(self.low, self.high, eyes)  # [D, C]
        rising, order = away.flatten().sort()
        reached = self.splats.expand(len(eyes), -1).flatten()[order].cumsum(0)
        return float(rising[int(torch.searchsorted(reached, reached[-1] / 2))])

    def near(self, distance: float) -> float:
        """`chunk_distance`, but at least half of the distance: a camera may be inside the boxes of splats far away."""
        return max(self.chunk_distance(distance), distance / 2)

    def camera_distance(self, distance: float) -> float:
        """The distance from the middle at which `chunk_distance` is this."""
        near, far = 0.0, distance
        while self.chunk_distance(far) < distance:
            near, far = far, 2 * far
        for _ in range(HALVINGS):
            half = (near + far) / 2
            near, far = (near, half) if self.chunk_distance(half) >= distance else (half, far)
        return far


def progression(rising: Sequence[float], ratio: float) -> tuple[float, float]:
    """`lodBaseDistance` and `lodMultiplier`: of those that PlayCanvas takes, the closest to the distances, by least squares of logarithms.

    `ratio`: the multiplier where there is only one distance.
    """
    logs = [math.log(distance) for distance in rising]
    middle = (len(logs) - 1) / 2
    spread = sum((number - middle) ** 2 for number in range(len(logs)))
    slope = sum((number - middle) * log for number, log in enumerate(logs)) / spread if spread else math.log(ratio)
    slope = max(slope, math.log(LEAST_MULTIPLIER))
    return max(math.exp(fmean(logs) - slope * middle), NEAREST), math.exp(slope)


def viewer_settings(manifest: dict[str, Any], approach: Approach | None, canvas: int) -> dict[str, Any]:
    """What a page has to set on its PlayCanvas splat component (the first two) and on `scene.gsplat`, and the zooms at which levels then change.

    `approach`: None for a ladder by distance, whose levels are made for distances from chunks, not from splats.
    """
    rising, scales = distances(manifest, canvas), [level["scale"] for level in manifest["levels"]]
    if approach is None:
        base = max(manifest["lodBaseDistance"] * canvas / manifest["canvas"], NEAREST)
        multiplier = max(manifest["lodMultiplier"], LEAST_MULTIPLIER)
        shown = [base * multiplier**number for number in range(len(rising))]
    else:
        base, multiplier = progression([approach.near(distance) for distance in rising], scales[0] / scales[1])
        shown = [approach.camera_distance(base * multiplier**number) for number in range(len(rising))]
    return {
        "lodBaseDistance": base,
        "lodMultiplier": multiplier,
        "splatBudgetMode": "limit",  # the default slides the distances until a number of splats is shown
        "splatBudget": max(BUDGET, manifest["levels"][0]["splats"]),  # of fewer, the distances slide in this mode too
        "lodUpdateDistance": MOVED * base,
        "canvas": canvas,
        "zooms": [switch["zoom"] * wanted / got for switch, wanted, got in zip(manifest["switches"], rising, shown, strict=True)],
    }


def write_streamed(folder: Path, canvas: int = CANVAS) -> Path:
    """Write Streamed SOG and the viewer's settings to the subfolder `streamed` of a ladder; return its lod-meta.json.

    Raises SettingsError without splat-transform and for a single level, OutputExists, OutputError.
    """
    manifest = read_manifest(folder)
    rising = distances(manifest, canvas)
    if not rising:
        raise SettingsError(f"{folder}: {SINGLE_LEVEL}; open its level as it is")
    if rising[0] < NEAREST:
        warn(TOO_SMALL.format(least=NEAREST, first=rising[0]))
    with new_folder(folder / STREAMED, overwrite=False) as temporary, TemporaryDirectory(prefix=TEMPORARY) as copies:
        made = temporary / LOD_META
        extent = manifest.get("chunk_extent", max(1, round(EXTENT * rising[0])))
        files = [level["file"] for level in manifest["levels"]]
        write_streamed_sog([readable(folder / file, Path(copies, file)) for file in files], made, extent)
        approach = None if manifest.get("by") == "distance" else Approach.to(manifest["middle"], read_chunks(made))
        write_json(temporary / SETTINGS, viewer_settings(manifest, approach, canvas), overwrite=False)
    return folder / STREAMED / LOD_META
