"""`levels.json`: what a ladder's files are, when each is to be shown, and how good it then is. For anybody who writes a viewer or a converter.

`levels.js` beside it is such a viewer, for pages of three.js.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean, median
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.report import Report
from mipmap_plugin.adaptation.views.pixel_size import pixel_size, seen_depth, seen_pixel_size
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.formats.atomic import new_folder, refuse_output, refuse_to_lose, refuse_unwritable, sha256, write_json
from mipmap_plugin.formats.json_file import read_json
from mipmap_plugin.frozen_base import FrozenBase
from mipmap_plugin.levels.contents import Contents
from mipmap_plugin.levels.yardstick import TRUTH
from mipmap_plugin.models.places import MANIFEST as MANIFEST
from mipmap_plugin.models.places import REPORT
from mipmap_plugin.scenes.photographed import GOLDEN

FORMAT = "mipmap_plugin levels 1"

# px: the shorter side of the canvas that distances are computed for, unless another is given; they are in proportion to it.
CANVAS = 1080

# Views that tell what they look at, by so many splats at most; and how many of these are told to what shows the ladder.
LOOKED_AT, SAMPLE, TOLD = 64, 100_000, 256

# A module for pages of three.js, such as Spark's, that shows the level that fits.
THREE_JS = "levels.js"

# What is written into the folder of a ladder, also by what converts one.
WRITTEN = (MANIFEST, THREE_JS, "level_*.ply", f"level_*.ply{REPORT}", "report.html", "streamed/*", "tiles/*")


def refuse_ladder(folder: Path, base: FrozenBase, *, overwrite: bool, room: int = 0) -> None:
    """Raise what writing a ladder to `folder` would raise. A folder with other things in it is never replaced. Raises OutputExists, OutputError.

    `room`: bytes that its disk needs (`room.room_for`).
    """
    source = base.model.source
    refuse_output(folder, overwrite, [] if source is None else [source])
    refuse_to_lose(folder, base.model.folder, MANIFEST, WRITTEN)
    refuse_unwritable(folder, room, what="the levels take about", why=", with what is kept of them until all are done")


def write_levels(levels: Sequence[Adapted], manifest_of: Callable[[list[Path]], dict[str, Any]], folder: Path, overwrite: bool) -> Path:
    """Write the levels, a report beside each, and the manifest of their files; the folder appears complete or not at all. Raises OutputExists,
    OutputError."""
    with new_folder(folder, overwrite) as temporary:
        files = [level.save(temporary / f"level_{number}.ply") for number, level in enumerate(levels)]  # 0 is the finest, as in other tools
        facts = manifest_of(files)
        write_json(temporary / MANIFEST, facts, overwrite=False)
        if "middle" in facts:  # the module shows ladders by zoom
            shutil.copyfile(Path(__file__).with_name(THREE_JS), temporary / THREE_JS)
    return folder


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a ladder in a folder. Raises SceneError if it is missing or no JSON."""
    found: dict[str, Any] = read_json(folder / MANIFEST)
    return found


def manifest(ladder: Contents, files: list[Path]) -> dict[str, Any]:
    """The manifest of a ladder whose levels are in `files`. Zooms and scales are focal lengths in px over that of the base."""
    first = ladder.levels[0].adapted.report
    return {
        "format": FORMAT,
        "viewer": ladder.request.viewer,
        "least_db": ladder.request.least_db,
        "base": first.base,
        "base_pixel": base_pixel(ladder.base),
        "view_pixel": view_pixel(ladder.base),
        "middle": ladder.levels[0].adapted.model.parameters()["means"].detach().median(dim=0).values.tolist(),
        "levels": [_entry(ladder, number, file) for number, file in enumerate(files)],
        "left_out": [asdict(level) for level in ladder.left_out],
        "switches": [asdict(switch) for switch in ladder.switches],
        "curve": [asdict(point) for point in ladder.curve],
        "worst_db": min(point.psnr_db for point in ladder.curve),
        "mean_db": fmean(point.psnr_db for point in ladder.curve),
        "measured": TRUTH,
        "versions": first.versions,
        "looked_at": looked_at(ladder.base),
    }


def base_pixel(base: FrozenBase) -> float:
    """The size in world units of a pixel of the base at its median splat of those in a picture, in the closest view; of all, if none is.

    It is for viewers that choose a level for each part of a scene: drawn as PlayCanvas does, flowers have up to 1.2 dB more than by `view_pixel`,
    and lego has as many from fewer splats.
    """
    means, views = base.model.parameters()["means"].detach(), base.views()
    seen = seen_pixel_size(means, views, base.effects().near_plane)
    return float((seen if len(seen) else pixel_size(means, views)).median())


def view_pixel(base: FrozenBase) -> float:
    """The size in world units of a pixel of the base at what its views look at: the median over views, each at the median splat of its picture.

    It is for viewers that change the whole scene at once: by `base_pixel` Spark showed lego with up to 4 dB less. Where no picture has any splat,
    at the median splat of all.
    """
    means, views, near = _looking(base)
    sizes = [seen_depth(view, means, near, 1 / 2) / math.sqrt(view.fx * view.fy) for view in views]
    return median(filter(math.isfinite, sizes)) if min(sizes) < math.inf else float(pixel_size(means, views).median())


def looked_at(base: FrozenBase) -> list[list[float]]:
    """What the views of the base look at: splats in their pictures, as many of each view. Of each x, y, z and the size of a pixel of that view there,
    in world units, to six digits.

    It is for viewers that change the whole scene at once, by what is in a picture. By the distance of the scene's middle, from which some of what
    the training's views show is twice as far away, or half, Spark showed captures with up to 3 dB less on small canvases.
    """
    means, views, near = _looking(base)
    each, told = math.ceil(TOLD / len(views)), []
    for number, view in enumerate(views):
        points = view.to_camera(means)
        seen = view.in_picture(points, near).nonzero()[:, 0]
        later = GOLDEN * number % 1  # of the way from one told splat to the next, so that the views tell different ones
        rows = seen[((torch.arange(each) + later) * len(seen) / each).long()] if len(seen) else seen
        sizes = points[rows, 2:] / math.sqrt(view.fx * view.fy)
        told += torch.cat([means[rows], sizes.to(means)], dim=1).tolist()
    return [[float(f"{value:.6g}") for value in row] for row in told]


def _looking(base: FrozenBase) -> tuple[Tensor, list[Camera], float]:
    """Some of the splats [N, 3] and of the views, which tell what views look at, and the near plane."""
    means = base.model.parameters()["means"].detach()
    return means[:: 1 + len(means) // SAMPLE], evenly(base.views(), LOOKED_AT), base.effects().near_plane


def _entry(ladder: Contents, number: int, file: Path) -> dict[str, Any]:
    """One level; it is shown from one switch to the next, the finest at every larger zoom and the coarsest at every smaller one."""
    level, zooms = ladder.levels[number], [switch.zoom for switch in ladder.switches]
    return {
        "file": file.name,
        "scale": level.band.scale,
        "shown_from": zooms[number] if number < len(zooms) else None,
        "shown_to": zooms[number - 1] if number else None,
        "adapted_from": level.adapted.report.settings.band[0] * level.band.scale,
        "adapted_to": level.adapted.report.settings.band[1] * level.band.scale,
        "splats": level.splats,
        **file_facts(file, level.adapted.report),
        "psnr_db": {f"{point.zoom:.4g}": point.psnr_db for point in ladder.curve if point.level == number},
    }


def file_facts(file: Path, report: Report) -> dict[str, Any]:
    """What the manifest says of a level's file and of how it was made."""
    return {"bytes": file.stat().st_size, "sha256": sha256(file), "seconds": report.seconds.get("total", 0.0), "holds": report.returned}
