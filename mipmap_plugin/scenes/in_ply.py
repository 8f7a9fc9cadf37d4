"""The camera that SHARP (Apple) writes into the PLY of the scene that it makes of one photograph."""

from __future__ import annotations

from pathlib import Path

import torch

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import CheckpointError, MipmapPluginError, SceneError
from mipmap_plugin.formats.ply import Header, read_element, read_header


def cameras_in(ply: Path | None) -> list[Camera]:
    """The camera in a PLY, by its elements `intrinsic` (3 x 3), `extrinsic` (4 x 4, from the world to the camera) and `image_size` (width, height).

    Empty for any other file. Raises SceneError for a camera that is none. (Elements: ml-sharp, src/sharp/utils/gaussians.py, `save_ply`.)
    """
    if ply is None or not ply.is_file():
        return []
    try:
        header = read_header(ply)
        intrinsic, extrinsic, size = (_numbers(ply, header, name, count) for name, count in (("intrinsic", 9), ("extrinsic", 16), ("image_size", 2)))
    except CheckpointError:  # no PLY, or a damaged one, of which whoever reads its splats tells
        return []
    if not (intrinsic and extrinsic and size):
        return []
    fx, _, cx, _, fy, cy, *_ = intrinsic
    try:
        return [Camera(int(size[0]), int(size[1]), fx, fy, cx, cy, torch.tensor(extrinsic, dtype=torch.float64).view(4, 4), name="photograph")]
    except (MipmapPluginError, ValueError, OverflowError) as error:  # the latter of a size that is no number
        raise SceneError(f"{ply}: the camera in it is none: {error}; give others (--cameras)") from error


def _numbers(ply: Path, header: Header, name: str, count: int) -> list[float]:
    """The `count` values of the element `name`, which has one property of the same name; empty if there is no such element."""
    for element in header.elements:
        if (element.name, element.names, element.count) == (name, (name,), count) and not element.has_lists:
            values: list[float] = read_element(ply, header, element)[name].tolist()
            return values
    return []
