"""Cameras in a PLY: that of the photograph that SHARP (Apple) made a scene of, and those that fVDB Reality Capture (NVIDIA) trained with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from mipmap_plugin.camera import OPENGL_TO_OPENCV, Camera
from mipmap_plugin.errors import MipmapPluginError, SceneError
from mipmap_plugin.formats.ply import Header, read_element, read_header

# Rows of the elements of SHARP's camera, each of which has one property of its own name.
ROWS = {"intrinsic": 9, "extrinsic": 16, "image_size": 2}

# Rows a camera of the elements of fVDB's, each of which has one property, `value`, and the number that stands for an orthographic camera
# (openvdb/fvdb-core, fvdb/enums.py). Others have a lens, and are taken for pinholes.
ROWS_EACH = {"camera_to_world_matrices": 16, "projection_matrices": 9, "image_sizes": 2}
MODELS, ORTHOGRAPHIC = "camera_models", 5


def cameras_in(ply: str | Path | None) -> list[Camera]:
    """The cameras in a PLY, by its elements. Empty for any other file. Raises SceneError for a camera that is none.

    SHARP's: `intrinsic` (3 x 3), `image_size` (width, height) and `extrinsic` (4 x 4, from the world to the camera; without it, as its ports to
    browsers write none, the camera is at the origin); ml-sharp, src/sharp/utils/gaussians.py, `save_ply`, `load_ply`. fVDB's:
    `camera_to_world_matrices` (N x 4 x 4, OpenCV's axes), `projection_matrices` (N x 3 x 3, px) and `image_sizes` (N x 2: height, width);
    openvdb/fvdb-reality-capture, `reconstruction_metadata`.
    """
    if ply is None or not Path(ply).is_file():
        return []
    try:
        header = read_header(ply)
    except MipmapPluginError:  # no PLY, or a damaged one, of which whoever reads its splats tells
        return []
    try:
        return _of_sharp(Path(ply), header) or _of_fvdb(Path(ply), header)
    except MipmapPluginError as error:
        raise SceneError(f"{ply}: the camera in it is none: {error}; give others (--cameras)") from error


def _of_sharp(ply: Path, header: Header) -> list[Camera]:
    held = {name for name in ROWS if any(element.name == name for element in header.elements)}
    if not {"intrinsic", "image_size"} <= held or any(_rows(header, name, name) != ROWS[name] for name in held):
        return []
    intrinsic, size = (_values(ply, header, name) for name in ("intrinsic", "image_size"))
    pose = _values(ply, header, "extrinsic").reshape(4, 4).astype(float) if "extrinsic" in held else torch.eye(4)
    return [Camera.of_matrices(pose, intrinsic.reshape(3, 3).astype(float), *size.tolist(), name="photograph")]


def _of_fvdb(ply: Path, header: Header) -> list[Camera]:
    count = _rows(header, "image_sizes", "value") // ROWS_EACH["image_sizes"]
    if not count or any(_rows(header, name, "value") != count * each for name, each in ROWS_EACH.items()):
        return []
    poses, matrices, sizes = (_values(ply, header, name) for name in ROWS_EACH)
    models = _values(ply, header, MODELS).tolist() if _rows(header, MODELS, "value") == count else [0] * count
    c2w = OPENGL_TO_OPENCV.new_tensor(poses.reshape(-1, 4, 4)) @ OPENGL_TO_OPENCV
    parts = zip(c2w, matrices.reshape(-1, 3, 3).astype(float), sizes.reshape(-1, 2).tolist(), strict=True)
    named = ((f"camera_{i:04d}", *each) for i, each in enumerate(parts) if models[i] != ORTHOGRAPHIC)
    return [Camera.of_opengl(pose, K, width, height, name=name) for name, pose, K, (height, width) in named]


def _rows(header: Header, name: str, only: str) -> int:
    """The number of rows of an element whose only property has the name `only` and is no list; 0 if there is none."""
    found = [element for element in header.elements if element.name == name and element.names == (only,) and not element.has_lists]
    return found[0].count if found else 0


def _values(ply: Path, header: Header, name: str) -> Any:
    """The values, a NumPy array, of an element of one property."""
    element = next(element for element in header.elements if element.name == name)
    return read_element(ply, header, element)[element.names[0]]
