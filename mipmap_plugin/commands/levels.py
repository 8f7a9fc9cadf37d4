"""`mipmap-plugin levels`."""

from __future__ import annotations

from pathlib import Path

from mipmap_plugin.commands.common import starting, without_none, wrap
from mipmap_plugin.commands.ladder_summary import print_summary
from mipmap_plugin.commands.ladders import Exports, saved
from mipmap_plugin.commands.outputs import folder_of_several
from mipmap_plugin.commands.types import BackendName, Background, Cameras, Checkpoint, Scale, ScreenFilter, Seed, Threads, Up, Viewer, Way
from mipmap_plugin.config import ViewPolicy
from mipmap_plugin.formats.atomic import named
from mipmap_plugin.formats.splat_transform import WRITTEN
from mipmap_plugin.jobs.base import Base


def levels(
    checkpoint: Checkpoint,
    viewer: Viewer,
    output: Path,
    coarsest: Scale = 1 / 16,
    ratio: float | None = None,
    least_db: float | None = None,
    until_splats: int | None = None,
    by: Way = "auto",
    streamed_sog: bool = False,
    tiles: bool = False,
    canvas: int | None = None,
    recipe: str = "default",
    views: ViewPolicy | None = None,
    cameras: Cameras = None,
    up: Up = None,
    steps: int | None = None,
    background: Background = None,
    screen_filter: ScreenFilter = None,
    backend: BackendName = "auto",
    threads: Threads = None,
    seed: Seed = 0,
    report: bool = False,
    overwrite: bool = False,
    json: bool = False,
) -> None:
    """Make a ladder of levels: files of one scene for every zoom, of which a viewer shows the one that fits.

    Args:
        checkpoint: A PLY, .spz, .sog, .splat or .glb, or a model folder.
        viewer: Viewer to make the levels for: spark, supersplat, classic, ... An unknown name lists all.
        output: Folder for the levels, a report beside each, and levels.json, which says when each is to be shown.
        coarsest: Zoom down to which levels are made; below it the last level is shown.
        ratio: Of neighboring scales; by default 1.74 for viewers that compensate or hardly dilate, else 1.41.
        least_db: Make a level again for a narrower band, down to a ratio of 1.19, if it falls below this PSNR at the ends of its band.
        until_splats: End with the first level that has at most this many splats, if that comes before the coarsest scale.
        by: zoom, one scale for the whole scene; distance, one for each splat; auto: distance for viewers that stream, if cameras see far away.
        streamed_sog: Also write Streamed SOG for PlayCanvas, SuperSplat and Babylon.js, through splat-transform, with the distances to set there.
        tiles: Also write 3D Tiles for Cesium, through splat-transform.
        canvas: With --streamed-sog or --tiles: the shorter side in px of the canvas that distances are computed for; by default 1080.
        recipe: default, thorough (more steps and views), instant (no optimization), or a registered one.
        views: Which views to adapt to; by default those of the recipe.
        steps: Maximum number of optimizer steps for each level.
        report: Also write report.html into the folder: dB over zoom with the switches and pictures at each, or by distance dB and pictures of walks.
        overwrite: Replace a ladder that exists.
        json: Print levels.json.
    """
    with starting():
        from mipmap_plugin.levels.request import LadderRequest

    exports = Exports(streamed_sog, tiles, canvas, named(checkpoint).name if report else None)
    exports.check(folder_of_several(output, (".ply", *WRITTEN, ".json")))
    request = LadderRequest(viewer, coarsest, ratio, least_db, until_splats, recipe, {"seed": seed, **without_none(views=views, steps=steps)}, by)
    base = Base(checkpoint, cameras, background, backend, screen_filter, up)
    manifest, files = saved(wrap(base, threads), request, output, exports, overwrite)
    print_summary(output, manifest, files, json)
