"""DyNeRF's videos (poses_bounds.npy), as 4DGaussians and Deformable 3D Gaussians read them.

Poses, intrinsics, sizes, times and splits are those of scene/neural_3D_dataset_NDC.py in 4DGaussians, and of `readCamerasFromNpy` in
scene/dataset_readers.py of Deformable 3D Gaussians.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SceneError, plural
from mipmap_plugin.formats.images import image_size, read_array
from mipmap_plugin.formats.json_file import positive, rotation
from mipmap_plugin.formats.nodes import is_file
from mipmap_plugin.scenes.base import Scene
from mipmap_plugin.scenes.training_options import DEFORMABLE, trained_size
from mipmap_plugin.scenes.transforms import viewmat_from_opengl

# px of the recorded width, to which focal lengths refer, and of the training size; and the number of frames of a video.
RECORDED, WIDTH, HEIGHT, FRAMES = 2704, 1352, 1014, 300

# By Deformable 3D Gaussians: the number of frames of a video.
FRAMES_OF_DEFORMABLE = 24


def is_dynerf(path: Path) -> bool:
    """Whether a folder is a capture of DyNeRF."""
    return (path / "poses_bounds.npy").is_file() and (any(path.glob("cam*")) or not (path / "images").is_dir())


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
