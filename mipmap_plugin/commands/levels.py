"""`mipmap-plugin levels`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mipmap_plugin.commands.common import print_facts, without_none, wrap
from mipmap_plugin.commands.types import Background, Checkpoint, Scale, ScreenFilter, Way
from mipmap_plugin.config import ViewPolicy
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.splat_transform import refuse_exchange

if TYPE_CHECKING:
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
    by: Way = "auto",
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
        by: zoom, one scale for the scene; distance, one for each splat, as viewers that stream chunks show it; auto: by the viewer and the scene.
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
        overwrite: Replace a ladder that exists.
        json: Print levels.json.
    """
    from mipmap_plugin.levels.request import LadderRequest

    (exports := Exports(streamed_sog, tiles, canvas)).check(output)
    settings = {"seed": seed, **without_none(views=views, steps=steps)}
    request = LadderRequest(viewer, coarsest, ratio, least_db, until_splats, recipe, settings, by)
    manifest, files = _saved(wrap(checkpoint, cameras, background, backend, screen_filter, threads), request, output, exports, overwrite)
    if json:
        print_facts(manifest, json)
    else:
        print_summary(output, manifest, files)


@dataclass(frozen=True)
class Exports:
    """What is written besides the levels."""

    streamed_sog: bool
    tiles: bool
    canvas: int  # px

    def check(self, output: Path) -> None:
        """Raise SettingsError for an impossible canvas, or if splat-transform is needed and not installed."""
        if self.canvas < 1:
            raise SettingsError(f"canvas: must be at least 1 px, got {self.canvas}")
        if self.streamed_sog or self.tiles:
            refuse_exchange(output)

    def write(self, ladder: Path) -> list[Path]:
        """Write them into the folder of a ladder; return the files that viewers open."""
        from mipmap_plugin.levels.streamed import write_streamed
        from mipmap_plugin.levels.tiles import write_tiles

        return ([write_streamed(ladder, self.canvas)] if self.streamed_sog else []) + ([write_tiles(ladder)] if self.tiles else [])


def _saved(wrapped: Wrapped, request: LadderRequest, output: Path, exports: Exports, overwrite: bool) -> tuple[dict[str, Any], list[Path]]:
    """Make and save a ladder; return its manifest and what was exported."""
    from mipmap_plugin.levels.ladder import make_levels
    from mipmap_plugin.levels.manifest import read_manifest, refuse_ladder
    from mipmap_plugin.wrap import state_path

    refuse_ladder(output, wrapped, overwrite=overwrite)
    saved = make_levels(wrapped, request, resume=state_path(output)).save(output, overwrite=overwrite)
    return read_manifest(saved), exports.write(saved)


def print_summary(folder: Path, manifest: dict[str, Any], exports: Sequence[Path] = ()) -> None:
    """Print what a ladder's manifest says, in lines."""
    if manifest.get("by") == "distance":
        _print_distances(folder, manifest)
    else:
        _print_zooms(folder, manifest)
    base = min(point["base_db"] for point in manifest["curve"])
    print(f"  at worst {manifest['worst_db']:.1f} dB, {manifest['mean_db']:.1f} on average; the base alone falls to {base:.1f} dB")
    print(f"  {manifest['measured']}")
    print("".join(f"  {path}\n" for path in exports), end="")


def _print_zooms(folder: Path, manifest: dict[str, Any]) -> None:
    print(f"{folder}, for {manifest['viewer']}: {len(manifest['levels'])} levels")
    for level in manifest["levels"]:
        ends = {"down to": level["shown_from"], "up to": level["shown_to"]}
        shown = ", ".join(f"{word} x{zoom:.3g}" for word, zoom in ends.items() if zoom is not None) or "at every zoom"
        quality = list(level["psnr_db"].values())
        print(f"  {level['file']}  x{level['scale']:.3g}, shown {shown}: {min(quality):.1f} to {max(quality):.1f} dB, ", end="")
        print(f"{level['splats']:,} splats, {level['bytes'] / 1e6:,.1f} MB, {level['seconds']:.0f} s")


def _print_distances(folder: Path, manifest: dict[str, Any]) -> None:
    print(f"{folder}, for {manifest['viewer']}: {len(manifest['levels'])} levels by distance")
    for level in manifest["levels"]:
        ends = {"from": level["distance_from"] or None, "to": level["distance_to"]}
        shown = " ".join(f"{word} {distance:.3g}" for word, distance in ends.items() if distance is not None) or "everywhere"
        print(f"  {level['file']}  shown {shown}: {level['splats']:,} splats, {level['bytes'] / 1e6:,.1f} MB, {level['seconds']:.0f} s")
    print(f"  distances in world units on a canvas of {manifest['canvas']} px: lodBaseDistance {manifest['lodBaseDistance']:.4g}, ", end="")
    print(f"lodMultiplier {manifest['lodMultiplier']:.3g}")
