"""`mipmap-plugin levels`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mipmap_plugin.commands.common import print_facts, without_none, wrap
from mipmap_plugin.commands.pages import LEVELS_PAGE as PAGE
from mipmap_plugin.commands.pages import look_at, write_levels_page
from mipmap_plugin.commands.types import Background, Checkpoint, Scale, ScreenFilter
from mipmap_plugin.config import ViewPolicy
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.splat_transform import refuse_exchange

if TYPE_CHECKING:
    from mipmap_plugin.levels.contents import Contents
    from mipmap_plugin.levels.request import LadderRequest
    from mipmap_plugin.wrap import Wrapped


def levels(
    checkpoint: Checkpoint,
    viewer: str,
    output: Path,
    coarsest: Scale = 1 / 16,
    ratio: float | None = None,
    least_db: float | None = None,
    until_splats: int | None = None,
    streamed_sog: bool = False,
    tiles: bool = False,
    canvas: int = 1080,
    recipe: str = "default",
    views: ViewPolicy | None = None,
    cameras: Path | None = None,
    steps: int | None = None,
    background: Background | None = None,
    screen_filter: ScreenFilter | None = None,
    backend: str = "auto",
    threads: int | None = None,
    seed: int = 0,
    report: bool = False,
    overwrite: bool = False,
    json: bool = False,
) -> None:
    """Make a ladder of levels: files of one scene for every zoom, of which a viewer shows the one that fits.

    Args:
        checkpoint: A PLY or a model folder.
        viewer: Viewer to make the levels for: spark, supersplat, classic, ... An unknown name lists all.
        output: Folder for the levels, a report beside each, and levels.json, which says when each is to be shown.
        coarsest: Zoom down to which levels are made; below it the last level is shown.
        ratio: Of neighboring scales; by default 1.74 for viewers that compensate or hardly dilate, else 1.41.
        least_db: Make a level again for a narrower band, down to a ratio of 1.19, if it falls below this PSNR at the ends of its band.
        until_splats: End with the first level that has at most this many splats, if that comes before the coarsest scale.
        streamed_sog: Also write Streamed SOG for PlayCanvas, SuperSplat and Babylon.js, through splat-transform, with the distances to set there.
        tiles: Also write 3D Tiles for Cesium, through splat-transform.
        canvas: Shorter side in px of the canvas that the distances of Streamed SOG are computed for.
        recipe: default, thorough (more steps and views), instant (no optimization), or a registered one.
        views: Which views to adapt to; by default those of the recipe.
        cameras: A cameras.json, a transforms file or a COLMAP scene, if there are no cameras beside the checkpoint.
        steps: Maximum number of optimizer steps for each level.
        background: Of the scene; by default that of the checkpoint, or else black.
        screen_filter: The filter that the checkpoint was trained with, if its files do not say: mip for a fused file of Mip-Splatting, for example.
        backend: Name of a backend; auto chooses the fastest one that can serve the request.
        threads: Maximum number of processor threads; by default as many as torch finds. With the backend cpu the result does not depend on it.
        seed: Seed of everything random.
        report: Also write report.html into the folder: dB over zoom with the switches, and pictures at each.
        overwrite: Replace a ladder that exists.
        json: Print levels.json.
    """
    from mipmap_plugin.levels.request import LadderRequest

    exports = Exports(streamed_sog, tiles, canvas, report)
    exports.check(output)
    settings = {"seed": seed, **without_none(views=views, steps=steps)}
    request = LadderRequest(viewer, coarsest, ratio, least_db, until_splats, recipe, settings)
    base = wrap(checkpoint, cameras, background, backend, screen_filter, threads)
    manifest, files = _saved(base, request, output, exports, checkpoint.resolve().name, overwrite)
    print_facts(manifest, json) if json else print_summary(output, manifest, files)


@dataclass(frozen=True)
class Exports:
    """What is written besides the levels."""

    streamed_sog: bool
    tiles: bool
    canvas: int  # px
    report: bool = False

    def check(self, output: Path) -> None:
        """Raise SettingsError for an impossible canvas, or if splat-transform is needed and not installed."""
        if self.canvas < 1:
            raise SettingsError(f"canvas: must be at least 1 px, got {self.canvas}")
        if self.streamed_sog or self.tiles:
            refuse_exchange(output)

    def write(self, ladder: Path, contents: Contents, title: str) -> list[Path]:
        """Write them into the folder of a ladder; return the files that viewers open, and the page at last."""
        page = [write_levels_page(ladder, contents, title)] if self.report else []
        return self._for_viewers(ladder) + page

    def _for_viewers(self, ladder: Path) -> list[Path]:
        from mipmap_plugin.levels.streamed import write_streamed
        from mipmap_plugin.levels.tiles import write_tiles

        return ([write_streamed(ladder, self.canvas)] if self.streamed_sog else []) + ([write_tiles(ladder)] if self.tiles else [])


def _saved(
    wrapped: Wrapped, request: LadderRequest, output: Path, exports: Exports, title: str, overwrite: bool
) -> tuple[dict[str, Any], list[Path]]:
    """Make and save a ladder; return its manifest and what was exported."""
    from mipmap_plugin.levels.ladder import make_levels
    from mipmap_plugin.levels.manifest import read_manifest, refuse_ladder
    from mipmap_plugin.wrap import state_path

    refuse_ladder(output, wrapped, overwrite=overwrite)
    ladder = make_levels(wrapped, request, resume=state_path(output))
    ladder.save(output, overwrite=overwrite)
    return read_manifest(output), exports.write(output, ladder.contents, title)


def print_summary(folder: Path, manifest: dict[str, Any], exports: Sequence[Path] = ()) -> None:
    """Print what a ladder's manifest says, in lines."""
    print(f"{folder}, for {manifest['viewer']}: {len(manifest['levels'])} levels")
    for level in manifest["levels"]:
        ends = {"down to": level["shown_from"], "up to": level["shown_to"]}
        shown = ", ".join(f"{word} x{zoom:.3g}" for word, zoom in ends.items() if zoom is not None) or "at every zoom"
        quality = list(level["psnr_db"].values())
        print(f"  {level['file']}  x{level['scale']:.3g}, shown {shown}: {min(quality):.1f} to {max(quality):.1f} dB, ", end="")
        print(f"{level['splats']:,} splats, {level['bytes'] / 1e6:,.1f} MB, {level['seconds']:.0f} s")
    base = min(point["base_db"] for point in manifest["curve"])
    print(f"  at worst {manifest['worst_db']:.1f} dB, {manifest['mean_db']:.1f} on average; the base alone falls to {base:.1f} dB")
    print(f"  {manifest['measured']}")
    print("".join(f"{look_at(path)}\n" if path.name == PAGE else f"  {path}\n" for path in exports), end="")
