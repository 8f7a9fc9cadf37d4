"""HyperNeRF's captures (dataset.json), as 4DGaussians and Deformable 3D Gaussians read them.

Poses, intrinsics, sizes, times and splits are those of scene/hyper_loader.py in 4DGaussians, and of `readNerfiesCameras` in
scene/dataset_readers.py of Deformable 3D Gaussians.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera, viewmat_of
from mipmap_plugin.errors import SceneError, some_of
from mipmap_plugin.formats.images import image_size
from mipmap_plugin.formats.json_file import numbers, pixels, positive, present, read_json, rotation
from mipmap_plugin.formats.nodes import is_file
from mipmap_plugin.scenes.base import Scene
from mipmap_plugin.scenes.training_options import DEFORMABLE, trained_size

# Photographs are taken at half their size; without a list of test views, every fourth view is for training.
HALF, EVERY = 2, 4

Chosen = tuple[str, Literal["train", "test"]]  # the name of a view, and its split


def is_hypernerf(path: Path) -> bool:
    """Whether a folder is a capture of HyperNeRF."""
    return (path / "dataset.json").is_file() and (path / "camera").is_dir()


def read_hypernerf(path: Path, cfg: dict[str, Any] | None) -> Scene:
    """The training and test views of a capture as 4DGaussians reads them, at half its size.

    With the cfg_args (`cfg`) of Deformable 3D Gaussians, as that does: from the scene's center, in its scale, by another time, and in a size
    and with a split by the name of the folder above. Raises SceneError.
    """
    cfg, deformable = cfg or {}, DEFORMABLE in (cfg or {})
    listed, facts = (_object(path / name) for name in ("dataset.json", "metadata.json"))
    names, key = _names(listed, "ids", path), "time_id" if deformable else "warp_id"
    shrunk, chosen = _of_deformable(path, listed, names, bool(cfg.get("eval"))) if deformable else (HALF, _chosen(path, listed, names))
    moments = {name: _moment(facts.get(name), key, f"{path / 'metadata.json'}, {name}") for name in (dict(chosen) if deformable else names)}
    last = max(moments.values(), default=0) or 1.0
    frame, resolution = (_frame(path / "scene.json"), cfg.get("resolution", 1)) if deformable else (None, 1)
    cameras: list[Camera] = []
    images: dict[Camera, Path] = {}
    for name, split in chosen:
        photograph = path / "rgb" / f"{shrunk}x" / f"{name}.png"
        camera = _of_capture(path / "camera" / f"{name}.json", name, split, moments[name] / last)
        camera = camera if frame is None else camera.moved(frame)
        exists = is_file(photograph)
        size = image_size(photograph) if exists else (max(1, camera.width // shrunk), max(1, camera.height // shrunk))
        camera = camera.resized(*trained_size(*size, {"resolution": resolution}))
        cameras.append(camera)
        if exists:
            images[camera] = photograph
    if not cameras:
        raise SceneError(f"{path / 'dataset.json'}: lists no view; copy it again")
    notes = [f"{some_of(len(cameras), len(names), 'view')} of a HyperNeRF capture, at 1/{shrunk} of its size"]
    return Scene(tuple(cameras), images, path, notes, as_4dgaussians=not deformable)


def _object(file: Path) -> dict[str, Any]:
    data = read_json(file)
    if not isinstance(data, dict):
        raise SceneError(f"{file}: holds no values by name; copy it again")
    return data


def _names(listed: dict[str, Any], key: str, path: Path) -> list[str]:
    names = listed.get(key, [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise SceneError(f"{path / 'dataset.json'}, {key}: is no list of names; copy it again")
    return names


def _moment(entry: Any, key: str, where: str) -> float:
    """The moment of a view, at least 0."""
    value = numbers(present(entry if isinstance(entry, dict) else {}, key, where), (), f"{where}, {key}").item()
    if value < 0:
        raise SceneError(f"{where}, {key}: is {value:g} but must be at least 0; correct the file")
    return value


def _chosen(path: Path, listed: dict[str, Any], names: list[str]) -> list[Chosen]:
    """The training and test views of 4DGaussians; the others are left out."""
    tests, trains = set(_names(listed, "val_ids", path)), set(_names(listed, "train_ids", path))
    if not tests:
        trains, tests = set(names[::EVERY]), set(names[EVERY // 2 :: EVERY])
    return [(name, "train") for name in names if name in trains] + [(name, "test") for name in names if name in tests]


def _of_deformable(path: Path, listed: dict[str, Any], names: list[str], held_out: bool) -> tuple[int, list[Chosen]]:
    """By how much Deformable 3D Gaussians shrinks the photographs, and its training and test views; it trains on all that are not held out."""
    above = path.absolute().parent.name
    shrunk = 4 if above.startswith("vrig") else 1 if above.startswith("NeRF") else HALF
    trains, tests = names[::EVERY], names[EVERY // 2 :: EVERY] if above.startswith("interp") else []
    if shrunk != HALF:
        trains, tests = _names(listed, "train_ids", path), _names(listed, "val_ids", path)
    return shrunk, [(name, "train") for name in trains] + [(name, "test" if held_out else "train") for name in tests]


def _frame(file: Path) -> Tensor:
    """The similarity [4, 4] float64 from the world of a capture to the one that is centered and scaled by its scene.json."""
    data, frame = _object(file), torch.eye(4, dtype=torch.float64)
    center = numbers(present(data, "center", str(file)), (3,), f"{file}, center")
    scale = positive(present(data, "scale", str(file)), f"{file}, scale")
    frame[:3] *= scale
    frame[:3, 3] = -scale * center
    return frame


def _of_capture(file: Path, name: str, split: Literal["train", "test"], time: float) -> Camera:
    """A camera of nerfies: world-to-camera rotation, position, and intrinsics, of which that project uses only the focal length."""
    data = _object(file)
    turn = rotation(present(data, "orientation", str(file)), f"{file}, orientation")
    eye = numbers(present(data, "position", str(file)), (3,), f"{file}, position")
    focal = positive(present(data, "focal_length", str(file)), f"{file}, focal_length")
    sides = numbers(present(data, "image_size", str(file)), (2,), f"{file}, image_size").tolist()
    width, height = (pixels(side, f"{file}, image_size") for side in sides)
    return Camera(width, height, focal, focal, width / 2, height / 2, viewmat_of(turn.T, eye), name, split, time)
