"""Scenes of 4DGaussians without transforms files: DyNeRF's videos (poses_bounds.npy) and HyperNeRF's captures (dataset.json).

Poses, intrinsics, sizes, times and splits are those of that project's scene/neural_3D_dataset_NDC.py and scene/hyper_loader.py; and those of
scene/dataset_readers.py in Deformable 3D Gaussians (`readNerfiesCameras`, `readCamerasFromNpy`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera, viewmat_of
from mipmap_plugin.errors import SceneError, plural, some_of
from mipmap_plugin.formats.images import image_size, is_file, read_array
from mipmap_plugin.formats.json_file import numbers, pixels, positive, present, read_json, rotation
from mipmap_plugin.scenes.base import Scene
from mipmap_plugin.scenes.training_options import DEFORMABLE, trained_size
from mipmap_plugin.scenes.transforms import viewmat_from_opengl

# DyNeRF: px of the recorded width, to which focal lengths refer, and of the training size; and the number of frames of a video.
RECORDED, WIDTH, HEIGHT, FRAMES = 2704, 1352, 1014, 300

# DyNeRF by Deformable 3D Gaussians: the number of frames of a video.
FRAMES_OF_DEFORMABLE = 24

# HyperNeRF: photographs are taken at half their size; without a list of test views, every fourth view is for training.
HALF, EVERY = 2, 4

View = tuple[str, Literal["train", "test"]]  # its name and split


def is_dynerf(path: Path) -> bool:
    """Whether a folder is a capture of DyNeRF."""
    return (path / "poses_bounds.npy").is_file() and (any(path.glob("cam*")) or not (path / "images").is_dir())


def is_hypernerf(path: Path) -> bool:
    """Whether a folder is a capture of HyperNeRF."""
    return (path / "dataset.json").is_file() and (path / "camera").is_dir()


def read_dynerf(path: Path, cfg: dict[str, Any] | None) -> Scene:
    """The cameras of all videos, the first for testing. Training cameras take turns, so that together they have one view per frame. Frames
    are in cam<NN>/images, if they were extracted.

    With the cfg_args (`cfg`) of Deformable 3D Gaussians, as that does: in frames/<video>, of which every camera has the first 24, at their own size.
    Raises SceneError.
    """
    rows = read_array(path / "poses_bounds.npy")
    if rows.dim() != 2 or rows.shape[1] != 17 or len(rows) < 2:
        raise SceneError(f"{path / 'poses_bounds.npy'}: expected one row of 17 numbers for each of several cameras, got {list(rows.shape)}")
    poses = rows[:, :15].reshape(-1, 3, 5)
    if cfg and DEFORMABLE in cfg:
        return _videos_of_deformable(path, poses, cfg)
    videos = sorted({entry.name.partition(".")[0] for entry in path.glob("cam*")}) or [f"cam{number:02d}" for number in range(len(poses))]
    if len(videos) != len(poses):
        has = f"has {plural(len(videos), 'video')} ({videos[0]}, ...)"
        raise SceneError(f"{path}: {has}, but poses_bounds.npy has {plural(len(poses), 'camera')}; copy all of them")
    cameras: list[Camera] = []
    images: dict[Camera, Path] = {}
    for number, (video, pose) in enumerate(zip(videos, poses, strict=True)):
        moments = range(FRAMES) if number == 0 else range(number - 1, FRAMES, len(poses) - 1)
        for moment in moments:
            camera = _of_video(pose, video, moment, "train" if number else "test", f"{path / 'poses_bounds.npy'}, row {number}")
            cameras.append(camera)
            if is_file(frame := path / video / "images" / f"{moment:04d}.png"):
                images[camera] = frame
    notes = [f"{plural(len(videos), 'video')} of {FRAMES} frames; the first is for testing, the others are seen at {FRAMES} moments in turn"]
    return Scene(tuple(cameras), images, path, notes, as_4dgaussians=True)


def read_hypernerf(path: Path, cfg: dict[str, Any] | None) -> Scene:
    """The training and test views of a capture as 4DGaussians reads them, at half its size.

    With the cfg_args (`cfg`) of Deformable 3D Gaussians, as that does: from the scene's center, in its scale, by another time, and in a size
    and with a split by the name of the folder above. Raises SceneError.
    """
    cfg, deformable = cfg or {}, DEFORMABLE in (cfg or {})
    listed, facts = (_object(path / name) for name in ("dataset.json", "metadata.json"))
    names, key = _names(listed, "ids", path), "time_id" if deformable else "warp_id"
    shrunk, chosen = _of_deformable(path, listed, names) if deformable else (HALF, _chosen(path, listed, names))
    moments = {name: _moment(facts.get(name), key, f"{path / 'metadata.json'}, {name}") for name in (dict(chosen) if deformable else names)}
    last = max(moments.values(), default=0) or 1.0
    frame, resolution = (_frame(path / "scene.json"), cfg.get("resolution", 1)) if deformable else (None, 1)
    cameras: list[Camera] = []
    images: dict[Camera, Path] = {}
    for name, split in chosen:
        photograph = path / "rgb" / f"{shrunk}x" / f"{name}.png"
        held_out = split == "test" and (not deformable or bool(cfg.get("eval")))
        camera = _of_capture(path / "camera" / f"{name}.json", name, "test" if held_out else "train", moments[name] / last)
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


def _videos_of_deformable(path: Path, poses: Tensor, cfg: dict[str, Any]) -> Scene:
    """The views of `poses` [P, 3, 5]; without frames at the recorded size. The focal length is that of the first camera, in pixels of the frames."""
    folders = sorted(folder for folder in path.glob("frames/*") if folder.is_dir())
    if folders and len(folders) != len(poses):
        has = f"has {plural(len(folders), 'video')}"
        raise SceneError(f"{path / 'frames'}: {has}, but poses_bounds.npy has {plural(len(poses), 'camera')}; copy all of them")
    height, width, focal = (positive(value, f"{path / 'poses_bounds.npy'}, row 0") for value in poses[0, :, 4].tolist())
    recorded, resized = (max(1, round(width)), max(1, round(height))), {"resolution": cfg.get("resolution", 1)}
    cameras: list[Camera] = []
    images: dict[Camera, Path] = {}
    for number, pose in enumerate(poses):
        viewmat = _viewmat(pose, f"{path / 'poses_bounds.npy'}, row {number}")
        folder = folders[number] if folders else path / "frames" / f"cam{number:02d}"
        found = sorted(folder.glob("[!.]*")) if folders else [folder / f"{moment:04d}.png" for moment in range(FRAMES_OF_DEFORMABLE)]
        split: Literal["train", "test"] = "test" if number == 0 and cfg.get("eval") else "train"
        for moment, frame in enumerate(found[:FRAMES_OF_DEFORMABLE]):
            across, down = image_size(frame) if folders else recorded
            name, time = f"{folder.name}/{frame.stem}", moment / (FRAMES_OF_DEFORMABLE - 1)
            camera = Camera(across, down, focal, focal, across / 2, down / 2, viewmat, name, split, time)
            cameras.append(camera.resized(*trained_size(across, down, resized)))
            if folders:
                images[cameras[-1]] = frame
    note = f"{plural(len(poses), 'video')} of {FRAMES_OF_DEFORMABLE} frames, as Deformable 3D Gaussians reads them"
    return Scene(tuple(cameras), images, path, [note])


def _of_video(pose: Tensor, video: str, moment: int, split: Literal["train", "test"], where: str) -> Camera:
    """`pose` as in `_viewmat`, at the training size of 4DGaussians."""
    focal = positive(pose[2, 4].item(), f"{where}, focal length") * WIDTH / RECORDED
    return Camera(WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2, _viewmat(pose, where), f"{video}/{moment:04d}", split, moment / FRAMES)


def _viewmat(pose: Tensor, where: str) -> Tensor:
    """`pose` [3, 5] in LLFF's convention: the camera's axes down, right and backwards, its position, and (height, width, focal length)."""
    down, right, back, eye, _ = pose.unbind(1)
    to_world = torch.eye(4, dtype=torch.float64)
    to_world[:3, :3] = rotation(torch.stack([right, -down, back], 1).tolist(), where)
    to_world[:3, 3] = eye
    return viewmat_from_opengl(to_world)


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


def _chosen(path: Path, listed: dict[str, Any], names: list[str]) -> list[View]:
    """The training and test views of 4DGaussians; the others are left out."""
    tests, trains = set(_names(listed, "val_ids", path)), set(_names(listed, "train_ids", path))
    if not tests:
        trains, tests = set(names[::EVERY]), set(names[EVERY // 2 :: EVERY])
    return [(name, "train") for name in names if name in trains] + [(name, "test") for name in names if name in tests]


def _of_deformable(path: Path, listed: dict[str, Any], names: list[str]) -> tuple[int, list[View]]:
    """By how much Deformable 3D Gaussians shrinks the photographs, and its training and test views."""
    above = path.absolute().parent.name
    shrunk = 4 if above.startswith("vrig") else 1 if above.startswith("NeRF") else HALF
    trains, tests = names[::EVERY], names[EVERY // 2 :: EVERY] if above.startswith("interp") else []
    if shrunk != HALF:
        trains, tests = _names(listed, "train_ids", path), _names(listed, "val_ids", path)
    return shrunk, [(name, "train") for name in trains] + [(name, "test") for name in tests]


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
    data = read_json(file)
    turn = rotation(present(data, "orientation", str(file)), f"{file}, orientation")
    eye = numbers(present(data, "position", str(file)), (3,), f"{file}, position")
    focal = positive(present(data, "focal_length", str(file)), f"{file}, focal_length")
    sides = numbers(present(data, "image_size", str(file)), (2,), f"{file}, image_size").tolist()
    width, height = (pixels(side, f"{file}, image_size") for side in sides)
    return Camera(width, height, focal, focal, width / 2, height / 2, viewmat_of(turn.T, eye), name, split, time)
