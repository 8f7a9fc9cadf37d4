"""Which intrinsics count where a transforms file has some, and a frame in it others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# Focal lengths: along x, by which a frame has a lens of its own, and along y.
FOCAL = ("fl_x", "camera_angle_x", "fl_y", "camera_angle_y")

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")

# What only files for nerfstudio have.
OF_NERFSTUDIO = ("camera_model", "applied_transform", "ply_file_path", "orientation_override", "train_filenames", "fisheye_crop_radius")

# What nerfstudio takes from the file where that has it, each by itself, and of the rest all or nothing (nerfstudio_dataparser.py).
SHARED, SHARED_DISTORTION, SIZE = ("fl_x", "fl_y", "cx", "cy"), (*DISTORTION, "distortion_params"), ("w", "h")


def values_of(data: Mapping[str, Any], frame: Mapping[str, Any]) -> dict[str, Any]:
    """What a transforms file and a frame in it say of the frame's view.

    A frame's own intrinsics count for more, as in instant-ngp, unless the file is nerfstudio's, which takes the file's. But no training fits
    these to a frame of another size.
    """
    data, frame = _stated(data), _stated(frame)
    shared: list[str] = []
    if any(key in data for key in OF_NERFSTUDIO) and all(frame[key] == data[key] for key in SIZE if key in frame and key in data):
        shared = [key for key in SHARED if key in data]
        shared += SHARED_DISTORTION if any(key in data for key in SHARED_DISTORTION) else []
    has_lens = any(key in frame and key not in shared for key in FOCAL[:2])
    others = [key for key in FOCAL if has_lens and key not in shared]  # of the file, which are of another lens
    return {**{key: value for key, value in data.items() if key not in others}, **{key: value for key, value in frame.items() if key not in shared}}


def overruled(data: Mapping[str, Any], frame: Mapping[str, Any]) -> bool:
    """Whether a frame has intrinsics of its own that do not count."""
    values = values_of(data, frame)
    return any(value != values.get(key) for key, value in _stated(frame).items() if key in SHARED + SHARED_DISTORTION)


def _stated(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Without those that are null."""
    return {key: value for key, value in entries.items() if value is not None}
