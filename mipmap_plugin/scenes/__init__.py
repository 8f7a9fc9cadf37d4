"""Scenes: cameras and images read from files, and generated views where there are none."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import CheckpointError, SceneError
from mipmap_plugin.formats.cfg_args import read_cfg_args
from mipmap_plugin.formats.json_file import read_json
from mipmap_plugin.limits import path_of
from mipmap_plugin.process.torch_modes import in_usual_modes
from mipmap_plugin.scenes.base import Scene
from mipmap_plugin.scenes.cameras_json import read_cameras, write_cameras
from mipmap_plugin.scenes.colmap import is_colmap, read_colmap
from mipmap_plugin.scenes.dynerf import is_dynerf, read_dynerf
from mipmap_plugin.scenes.hypernerf import is_hypernerf, read_hypernerf
from mipmap_plugin.scenes.in_ply import cameras_in
from mipmap_plugin.scenes.training_options import DEFORMABLE, UNBENT, photographs_folder, unbent_by
from mipmap_plugin.scenes.trajectories import jittered
from mipmap_plugin.scenes.transforms import read_transforms

# What a cameras.json was written with, beside it.
OPTIONS = "cfg_args"

# The names of the files of a COLMAP model.
COLMAP_FILES = {f"{name}{suffix}" for name in ("cameras", "images", "points3D", "frames", "rigs") for suffix in (".bin", ".txt")}

# Files by which captures are known that no training of splats takes as they are, and what made them.
RAW = {"keyframes/*cameras": "Polycam", "rgbd/0.*": "Record3D", "depth/0.exr": "Record3D"}

__all__ = [
    "DEFORMABLE", "Scene", "cameras_in", "jittered", "load_photographs", "load_scene", "model_cameras", "read_cameras", "read_colmap",
    "read_transforms", "unread_cameras", "write_cameras",
]  # fmt: skip


@in_usual_modes
def load_scene(path: str | Path, cfg: dict[str, Any] | None = None) -> Scene:
    """The scene at `path`: a model folder with a cameras.json, that file itself, a transforms file of any name or its folder, a COLMAP
    scene, one of DyNeRF or HyperNeRF as 4DGaussians reads them, or a PLY that has a camera in it (`cameras_in`).

    `cfg` is the checkpoint's cfg_args, which determine the test split and training size (`read_cameras`, `read_colmap`, `read_transforms`), and
    the frame of HyperNeRF's captures, which Deformable 3D Gaussians moves and scales, and which frames of DyNeRF's it takes; without it (a lone
    file, exported from a model folder) a cameras.json is read with the cfg_args beside it. A folder with both COLMAP's `sparse` and
    transforms files is read from `sparse`, as graphdeco-inria does.
    Raises SceneError, and SettingsError for what is no path.
    """
    path = path_of(path)
    if not path.exists():
        raise SceneError(f"{path}: there is no such file or folder; check the path")
    if path.is_file():
        return _of_file(path, cfg)
    if (path / "cameras.json").is_file():
        return _cameras_only(path / "cameras.json", path, cfg)
    if (path / "sparse").is_dir():
        return read_colmap(path, cfg)
    if any(path.glob("transforms*.json")):
        return read_transforms(path, cfg)
    if is_dynerf(path):
        return read_dynerf(path, cfg)
    if is_hypernerf(path):
        return read_hypernerf(path, cfg)
    if is_colmap(path):
        return read_colmap(path, cfg)
    if maker := next((maker for files, maker in RAW.items() if any(path.glob(files))), None):
        advice = "give what the checkpoint was trained on, such as the folder with a transforms.json that ns-process-data makes of it"
        raise SceneError(f"{path}: is a capture as {maker} exports it, whose cameras are not read here; {advice}")
    advice = f"give the folder or file that has the cameras{f', such as {found[0]}' if (found := _near(path)) else ''}"
    raise SceneError(f"{path}: holds neither cameras.json nor transforms files nor a COLMAP model; {advice}")


def load_photographs(path: str | Path, cfg: dict[str, Any]) -> Scene:
    """The scene at `path` with photographs at their own size, whatever size a checkpoint with these cfg_args was trained at.

    Only those options count by which Deformable 3D Gaussians reads captures of DyNeRF and HyperNeRF, and others take lenses of COLMAP for pinholes,
    and the folder of photographs, if it is neither `images` nor one of copies.
    Raises SceneError.
    """
    path = path_of(path)
    if DEFORMABLE in cfg and (is_dynerf(path) or is_hypernerf(path)):
        return load_scene(path, {**cfg, "resolution": 1})
    if not is_colmap(path):
        return load_scene(path)
    kept = {name: cfg[name] for name in UNBENT if name in cfg} if unbent_by(cfg) else {}
    folder = photographs_folder(cfg)
    if not re.fullmatch(r"images(_\d+)?", folder) and (path / folder).is_dir():
        kept |= {"images": folder}
    return load_scene(path, kept or None)


def model_cameras(folder: str | Path | None, cfg: dict[str, Any] | None = None) -> list[Camera]:
    """The cameras beside a checkpoint, at their training size; empty if there are none. Raises SceneError for a damaged file."""
    if folder is None or not (Path(folder) / "cameras.json").is_file():
        return []
    return read_cameras(Path(folder) / "cameras.json", cfg)


def unread_cameras(source: Path | None) -> Path | None:
    """The cameras.json in the folder of a lone file of splats: it may be of another scene, and is only read where it is asked for."""
    file = source.parent / "cameras.json" if source is not None else None
    return file if file is not None and file.is_file() else None


def _of_file(path: Path, cfg: dict[str, Any] | None) -> Scene:
    """The scene of one file: a PLY with a camera; with frames a transforms file, whatever its name, else a cameras.json. Raises SceneError."""
    if cameras := cameras_in(path):
        return Scene(tuple(cameras), {}, path, [])
    if path.suffix.lower() != ".json":
        there = f"; give its folder, {path.parent}" if path.name in COLMAP_FILES else "; export them as one of these"
        if path.suffix.lower() == ".ply":
            there = "; this PLY has no camera in it: give the cameras of its scene"
        raise SceneError(f"{path}: is no file of cameras that is read here (cameras.json, a transforms.json, or the folder of a COLMAP model){there}")
    data = read_json(path)
    if path.name.startswith("transforms") or (isinstance(data, dict) and "frames" in data):
        return read_transforms(path, cfg)
    if isinstance(data, dict):
        raise SceneError(f"{path}: has no cameras: neither the frames of a transforms.json nor the list of a cameras.json; give one of these")
    return _cameras_only(path, path, cfg)


def _near(path: Path) -> list[Path]:
    """Folders with cameras below a folder or one level above it: of a COLMAP scene people give `images`, or what holds several scenes."""
    try:
        return [place for place in (*sorted(path.glob("*")), *sorted(path.glob("*/*")), path.parent) if place.is_dir() and _holds_cameras(place)]
    except OSError:
        return []


def _holds_cameras(path: Path) -> bool:
    return (path / "cameras.json").is_file() or any(path.glob("transforms*.json")) or is_colmap(path)


def _cameras_only(file: Path, source: Path, cfg: dict[str, Any] | None) -> Scene:
    if not cfg and (beside := file.with_name(OPTIONS)).is_file():
        try:
            cfg = read_cfg_args(beside)
        except CheckpointError as error:
            raise SceneError(f"{error}; without it the size of the cameras in {file} is not known: mend it, or take it away") from error
    notes = [] if cfg else [f"{file.name} was read without cfg_args: all cameras count as training views, at the size that the file states"]
    return Scene(tuple(read_cameras(file, cfg)), {}, source, notes)
