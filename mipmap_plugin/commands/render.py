"""`mipmap-plugin render`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import tyro

from mipmap_plugin.camera import Camera
from mipmap_plugin.commands.common import wrap
from mipmap_plugin.commands.outputs import picture_names
from mipmap_plugin.commands.types import Background, Checkpoint, Scale
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.files import refuse_existing
from mipmap_plugin.scenes.images import write_image
from mipmap_plugin.wrap import Wrapped


def render(
    checkpoint: Checkpoint,
    output: Path,
    scale: Scale = 1.0,
    view: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    screen_filter: Literal["trained", "scaled", "classic", "antialiased", "mip", "analytic", "window"] = "trained",
    supersampling: int = 1,
    filter_3d: bool = False,
    cameras: Path | None = None,
    background: Background | None = None,
    backend: str = "auto",
    overwrite: bool = False,
) -> None:
    """Render views of a checkpoint as PNG files.

    Args:
        checkpoint: A PLY or a model folder.
        output: The folder for the pictures.
        scale: Zoom, relative to the cameras.
        view: Name of a view; may be given several times. By default all test views, or all if there are none.
        screen_filter: trained: what the checkpoint was trained with; scaled: the training-free filter for this scale.
        supersampling: N: N x N samples a pixel.
        filter_3d: Smooth every splat by what the cameras could see of it at best, as Mip-Splatting's 3D filter does.
        cameras: A cameras.json, a transforms file or a COLMAP scene, where the checkpoint has none beside it.
        background: Of the scene; by default what the checkpoint says, else black.
        backend: A backend's name; auto takes the fastest that can do it.
        overwrite: Replace pictures that exist.
    """
    wrapped = wrap(checkpoint, cameras, background, backend)
    views = _named(wrapped, view)
    names = picture_names(views)
    for name in names:
        refuse_existing(output / name, overwrite)
    for camera, name in zip(views, names, strict=True):
        asked = None if screen_filter == "trained" else screen_filter
        image = wrapped.render(camera.zoomed(scale), scale, asked, supersampling, filter_3d).image
        write_image(output / name, image, overwrite=overwrite)
    print(f"{len(views)} pictures in {output}")


def _named(wrapped: Wrapped, names: Sequence[str]) -> list[Camera]:
    cameras = wrapped.views()
    if not names:
        return [c for c in cameras if c.split == "test"] or cameras
    found = [c for c in cameras if c.name in names]
    if missing := set(names) - {c.name for c in found}:
        some = ", ".join(c.name for c in cameras[:5])
        raise SettingsError(f"there is no view {', '.join(sorted(missing))}; the first of {len(cameras)} are {some}")
    return found
