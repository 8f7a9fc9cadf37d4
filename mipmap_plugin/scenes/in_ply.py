"""The camera that SHARP (Apple) writes into the PLY of the scene that it makes of one photograph."""

from __future__ import annotations

from pathlib import Path

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import MipmapPluginError, SceneError
from mipmap_plugin.formats.ply import read_element, read_header

# Rows of the camera's elements, each of which has one property of its own name.
ROWS = {"intrinsic": 9, "extrinsic": 16, "image_size": 2}


def cameras_in(ply: str | Path | None) -> list[Camera]:
    """The camera in a PLY, by its elements `intrinsic` (3 x 3), `extrinsic` (4 x 4, from the world to the camera) and `image_size` (width, height).

    Empty for any other file. Raises SceneError for a camera that is none. (Elements: ml-sharp, src/sharp/utils/gaussians.py, `save_ply`.)
    """
    if ply is None or not Path(ply).is_file():
        return []
    try:
        header = read_header(ply)
    except MipmapPluginError:  # no PLY, or a damaged one, of which whoever reads its splats tells
        return []
    found = {element.name: element for element in header.elements if element.count == ROWS.get(element.name) and element.names == (element.name,)}
    if len(found) < len(ROWS) or any(element.has_lists for element in found.values()):
        return []
    try:
        intrinsic, extrinsic, size = (read_element(Path(ply), header, found[name])[name] for name in ROWS)
        pose, matrix = extrinsic.reshape(4, 4).astype(float), intrinsic.reshape(3, 3).astype(float)
        return [Camera.of_matrices(pose, matrix, *size.tolist(), name="photograph")]
    except MipmapPluginError as error:
        raise SceneError(f"{ply}: the camera in it is none: {error}; give others (--cameras)") from error
