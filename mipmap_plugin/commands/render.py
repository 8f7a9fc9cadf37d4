"""`mipmap-plugin render`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from mipmap_plugin.commands.common import wrap
from mipmap_plugin.commands.outputs import picture_names
from mipmap_plugin.commands.types import Background, Checkpoint, Scale
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.atomic import refuse_output, refuse_unwritable

if TYPE_CHECKING:
    from mipmap_plugin.backends.base import Rendered
    from mipmap_plugin.camera import Camera
    from mipmap_plugin.wrap import RenderOptions, Wrapped


def render(
    checkpoint: Checkpoint,
    output: Path,
    scale: Scale = 1.0,
    view: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    screen_filter: Literal["trained", "scaled", "classic", "antialiased", "mip", "analytic", "window"] = "trained",
    viewer: str | None = None,
    supersampling: int = 1,
    filter_3d: bool = False,
    depth: bool = False,
    normals: bool = False,
    exposure: bool = False,
    cameras: Path | None = None,
    background: Background | None = None,
    backend: str = "auto",
    overwrite: bool = False,
) -> None:
    """Render views of a checkpoint as PNG files, and depth and normals beside them.

    Args:
        checkpoint: A PLY or a model folder.
        output: The folder for the pictures.
        scale: Zoom, relative to the cameras.
        view: Name of a view; may be given several times. By default all test views, or all if there are none.
        screen_filter: trained: what the checkpoint was trained with; scaled: the training-free filter for this scale.
        viewer: Draw the checkpoint as this viewer does: classic, spark, playcanvas (or supersplat), gaussian-splats-3d, ... An unknown
            name lists them all.
        supersampling: N: N x N samples a pixel.
        filter_3d: Smooth every splat by what the cameras could see of it at best, as Mip-Splatting's 3D filter does.
        depth: Also write NAME_depth.npy, [height, width] float32: world units along the optical axis, 0 where nothing is.
        normals: Also write NAME_normals.npy, [height, width, 3] float32: unit vectors in world axes, 0 where nothing is.
        exposure: Show each view by the exposure of its photograph, where training made one (exposure.json of 3DGS).
        cameras: A cameras.json, a transforms file or a COLMAP scene, where the checkpoint has none beside it.
        background: Of the scene; by default what the checkpoint says, else black.
        backend: A backend's name; auto takes the fastest that can do it.
        overwrite: Replace pictures that exist.
    """
    wrapped = wrap(checkpoint, cameras, background, backend)
    views = _named(wrapped, view)
    asked = None if screen_filter == "trained" else screen_filter
    if viewer is not None:
        wrapped.effects(scale, asked, supersampling, viewer)  # before anything is looked for or written
    outputs = [name for name, wanted in {"depth": depth, "normals": normals}.items() if wanted]
    pictures = [output / name for name in picture_names(views)]
    _refuse(wrapped, pictures, outputs, overwrite)
    if exposure:
        for camera in views:
            wrapped.model.traits.exposures.of(camera)  # before anything is written
    drawn: RenderOptions = {"viewer": viewer, "filter_3d": filter_3d, "outputs": outputs, "exposure": exposure}
    for camera, picture in zip(views, pictures, strict=True):
        _write(picture, wrapped.render(camera.zoomed(scale), scale, asked, supersampling, **drawn), outputs, overwrite)
    print(f"{len(views)} pictures in {output}")


def _refuse(wrapped: Wrapped, pictures: Sequence[Path], outputs: Sequence[str], overwrite: bool) -> None:
    """Raise what writing the pictures, and what goes beside them, would raise."""
    from mipmap_plugin.models.outputs import parts_of

    parts = parts_of(wrapped.model.source, wrapped.model.folder)
    for picture in pictures:
        for path in (picture, *(_beside(picture, name) for name in outputs)):
            refuse_output(path, overwrite, parts, is_file=True)
    refuse_unwritable(pictures[0])


def _write(picture: Path, rendered: Rendered, outputs: Sequence[str], overwrite: bool) -> None:
    from mipmap_plugin.formats.images import write_array, write_image

    write_image(picture, rendered.image, overwrite=overwrite)
    for name in outputs:
        write_array(_beside(picture, name), getattr(rendered, name), overwrite=overwrite)


def _beside(picture: Path, name: str) -> Path:
    return picture.with_name(f"{picture.stem}_{name}.npy")


def _named(wrapped: Wrapped, names: Sequence[str]) -> list[Camera]:
    cameras = wrapped.views()
    if not names:
        return [c for c in cameras if c.split == "test"] or cameras
    found = [c for c in cameras if c.name in names]
    if missing := set(names) - {c.name for c in found}:
        some = ", ".join(c.name for c in cameras[:5])
        raise SettingsError(f"there is no view {', '.join(sorted(missing))}; the first of {len(cameras)} are {some}")
    return found
