"""`levels.json` of levels by distance, with the keys of a ladder by zoom: zooms are those of the scene's nearest parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.frozen_base import FrozenBase
from mipmap_plugin.levels.contents import LeftOut
from mipmap_plugin.levels.distance.scene import DistanceScene
from mipmap_plugin.levels.distance.yardstick import TRUTH, WalkPoint
from mipmap_plugin.levels.manifest import CANVAS, FORMAT, file_facts


@dataclass(frozen=True, eq=False)
class DistanceContents:
    """Levels from the finest to the coarsest, and how good they are on walks."""

    scene: DistanceScene
    levels: list[Adapted]
    curve: list[WalkPoint]
    left_out: Sequence[LeftOut]  # beyond the last level, by falling scale

    @property
    def base(self) -> FrozenBase:
        return self.scene.base


def manifest(ladder: DistanceContents, files: list[Path]) -> dict[str, Any]:
    """The manifest of a ladder whose levels are in `files`."""
    scene, first = ladder.scene, ladder.levels[0].report
    switches = [scene.rule.ends(number)[1] for number in range(scene.rule.count - 1)]
    distance, multiplier = scene.rule.playcanvas(CANVAS)
    return {
        "format": FORMAT,
        "by": "distance",
        "viewer": scene.request.viewer,
        "base": first.base,
        "base_pixel": scene.near,
        "levels": [_entry(ladder, number, file) for number, file in enumerate(files)],
        "switches": [{"pixel": size, "zoom": scene.near / size} for size in switches],
        "left_out": [asdict(level) for level in ladder.left_out],
        "lodBaseDistance": distance,
        "lodMultiplier": multiplier,
        "canvas": CANVAS,
        "chunk_extent": scene.extent,
        "curve": [{"zoom": scene.near / point.pixel, **asdict(point)} for point in ladder.curve],
        "worst_db": min(point.psnr_db for point in ladder.curve),
        "mean_db": fmean(point.psnr_db for point in ladder.curve),
        "measured": TRUTH,
        "versions": first.versions,
    }


def _entry(ladder: DistanceContents, number: int, file: Path) -> dict[str, Any]:
    """One level, and the distances on the canvas between which it is shown; null: no limit."""
    level, rule = ladder.levels[number], ladder.scene.rule
    low, high = rule.ends(number)
    last = number == rule.count - 1
    to_distance = rule.playcanvas(CANVAS)[0] / rule.first
    return {
        "file": file.name,
        "scale": ladder.scene.scale(number),
        "pixel_from": low,
        "pixel_to": None if last else high,
        "distance_from": low * to_distance,
        "distance_to": None if last else high * to_distance,
        "splats": level.report.gaussians_after,
        **file_facts(file, level.report),
        "psnr_db": {f"{ladder.scene.near / point.pixel:.4g}": point.psnr_db for point in ladder.curve if point.level == number},
    }
