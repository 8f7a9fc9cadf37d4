"""Captures of moving scenes as their projects publish them: DyNeRF's videos and HyperNeRF's frames."""

import json

import numpy as np
import tiny
from PIL import Image


def poses(count=4):
    """[count, 3, 4] camera to world with OpenGL axes, somewhere."""
    views = tiny.cameras(count)
    flip = np.diag([1.0, -1, -1, 1])
    return np.stack([(np.linalg.inv(view.viewmat.numpy()) @ flip)[:3] for view in views])


def dynerf(path, count=4, frames=0):
    """poses_bounds.npy as LLFF writes it: axes down, right, backwards, the place, height, width and focal length; near and far."""
    path.mkdir(parents=True)
    p = poses(count)
    size = np.broadcast_to(np.array([2028.0, 2704.0, 1460.0])[:, None], (count, 3, 1))
    llff = np.concatenate([-p[..., 1:2], p[..., 0:1], p[..., 2:4], size], -1)
    np.save(path / "poses_bounds.npy", np.concatenate([llff.reshape(count, 15), np.tile([1.0, 9.0], (count, 1))], 1))
    for number in range(count):
        (path / f"cam{number:02d}.mp4").touch()
        for frame in range(frames):
            (path / f"cam{number:02d}/images").mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(path / f"cam{number:02d}/images/{frame:04d}.png")
    return path


def hypernerf(path, count=9, val=True, rgb=True):
    (path / "camera").mkdir(parents=True)
    names = [f"{number:06d}" for number in range(count)]
    for name, pose in zip(names, poses(count), strict=True):
        turn = (pose[:, :3] @ np.diag([1.0, -1, -1])).T
        lens = {"focal_length": 500.0, "principal_point": [250.0, 310.0], "image_size": [536, 960], "pixel_aspect_ratio": 1.0, "skew": 0.0}
        (path / f"camera/{name}.json").write_text(json.dumps({"orientation": turn.tolist(), "position": pose[:, 3].tolist(), **lens}))
        if rgb:
            (path / "rgb/2x").mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.zeros((480, 268, 3), np.uint8)).save(path / f"rgb/2x/{name}.png")
    splits = {"train_ids": names[::2], "val_ids": names[1::2]} if val else {"train_ids": [], "val_ids": []}
    (path / "dataset.json").write_text(json.dumps({"count": count, "ids": names, **splits}))
    (path / "metadata.json").write_text(json.dumps({name: {"warp_id": i, "appearance_id": i, "camera_id": 0} for i, name in enumerate(names)}))
    return path
