"""Cameras of DyNeRF and HyperNeRF scenes, where 4DGaussians takes them from, against its own arithmetic in NumPy."""

import json
import warnings
from dataclasses import replace

import moving
import numpy as np
import pytest
import tiny
import torch
from moving_captures import dynerf, hypernerf, poses
from PIL import Image

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.target.photographs import scene_of
from mipmap_plugin.commands.common import scene
from mipmap_plugin.errors import SceneError, SettingsError
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.scenes import load_photographs, load_scene, read_cameras, write_cameras


def project_pose(pose):
    """R and T of load_images_path, and getWorld2View2 of both."""
    rotation = -pose[:3, :3]
    rotation[:, 0] = -rotation[:, 0]
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = rotation.T, -pose[:3, 3].dot(rotation)
    return view


def test_dynerf_cameras_are_those_of_its_loader(tmp_path):
    scene = load_scene(dynerf(tmp_path / "s"))
    tests, trains = scene.split("test"), scene.split("train")
    assert len(tests) == len(trains) == 300
    stored = np.load(tmp_path / "s/poses_bounds.npy")[:, :-2].reshape(-1, 3, 5)
    turned = np.concatenate([stored[..., 1:2], -stored[..., :1], stored[..., 2:4]], -1)
    for camera in (tests[7], trains[0], trains[150], trains[299]):
        wanted = project_pose(turned[int(camera.name[3:5])])
        assert np.allclose(camera.viewmat.numpy(), wanted, atol=1e-9)
        assert (camera.width, camera.height, camera.fx, camera.time) == (1352, 1014, 730.0, int(camera.name[-4:]) / 300)
    assert sorted(camera.time for camera in trains) == [frame / 300 for frame in range(300)]
    assert {camera.name[:5] for camera in tests} == {"cam00"} and {camera.name[:5] for camera in trains} == {"cam01", "cam02", "cam03"}


def test_extracted_dynerf_frames_belong_to_their_cameras(tmp_path):
    scene = load_scene(dynerf(tmp_path / "s", frames=3))
    assert {path.relative_to(tmp_path / "s").as_posix() for path in scene.images.values()} == {
        *(f"cam00/images/000{i}.png" for i in range(3)), "cam01/images/0000.png", "cam02/images/0001.png", "cam03/images/0002.png",
    }  # fmt: skip


@pytest.mark.parametrize("resolution, size", [(1, (40, 30)), (-1, (40, 30)), (2, (20, 15))])
def test_videos_of_deformable_are_those_of_its_loader(tmp_path, resolution, size):
    """readCamerasFromNpy: the first 24 frames of every video, from 0 to 1 in time, at their own size, to which the focal length refers."""
    path = dynerf(tmp_path / "s")
    for video in range(4):
        (path / f"frames/cam{video:02d}").mkdir(parents=True)
        for frame in range(26):
            Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(path / f"frames/cam{video:02d}/{frame:03d}.png")
    for place in ("frames", "frames/cam00"):
        (path / place / ".DS_Store").touch()
    scene = load_scene(path, {"is_6dof": False, "eval": True, "resolution": resolution})
    tests, trains = scene.split("test"), scene.split("train")
    assert len(tests) == 24 and len(trains) == 3 * 24 and len(scene.images) == 96
    stored = np.load(path / "poses_bounds.npy")[:, :-2].reshape(-1, 3, 5)
    turned = np.concatenate([stored[..., 1:2], -stored[..., :1], stored[..., 2:4]], -1)
    for camera, video, frame in ((tests[7], 0, 7), (trains[0], 1, 0), (trains[71], 3, 23)):
        assert scene.images[camera] == path / f"frames/cam{video:02d}/{frame:03d}.png"
        assert np.allclose(camera.viewmat.numpy(), project_pose(turned[video]), atol=1e-9)
        assert ((camera.width, camera.height), camera.fx, camera.fy, camera.time) == (size, 1460 * size[0] / 40, 1460 * size[1] / 30, frame / 23)


def test_videos_of_deformable_without_frames_have_the_recorded_size(tmp_path):
    path, cfg = dynerf(tmp_path / "s"), {"is_6dof": False, "resolution": -1}
    scene = load_scene(path, cfg)
    assert len(scene.split("train")) == 96 and not scene.images
    assert {(camera.width, camera.height) for camera in scene.cameras} == {(1600, 1200)} and scene.cameras[0].fx == pytest.approx(1460 * 1600 / 2704)
    assert {(camera.width, camera.height) for camera in load_photographs(path, cfg).cameras} == {(2704, 2028)}


@pytest.mark.parametrize("rgb", [True, False])
def test_hypernerf_cameras_are_those_of_its_loader(tmp_path, rgb):
    scene = load_scene(hypernerf(tmp_path / "s", rgb=rgb))
    assert [camera.name for camera in scene.split("test")] == ["000001", "000003", "000005", "000007"]
    for number, pose in enumerate(poses(9)):
        [camera] = [camera for camera in scene.cameras if int(camera.name) == number]
        wanted = np.linalg.inv(np.vstack([pose @ np.diag([1.0, -1, -1, 1]), [0, 0, 0, 1]]))
        assert np.allclose(camera.viewmat.numpy(), wanted, atol=1e-9)
        assert (camera.width, camera.height, camera.fx, camera.cx, camera.time) == (268, 480, 250.0, 134.0, number / 8)
        assert (camera in scene.images) == rgb


def test_hypernerf_without_test_views_trains_on_every_fourth(tmp_path):
    scene = load_scene(hypernerf(tmp_path / "s", val=False))
    assert [int(camera.name) for camera in scene.split("train")] == [0, 4, 8]
    assert [int(camera.name) for camera in scene.split("test")] == [2, 6]


@pytest.mark.parametrize(
    ("above", "shrunk", "train", "test"),
    [("vrig-chicken", 4, [0, 2, 4, 6, 8], [1, 3, 5, 7]), ("NeRF-DS", 1, [0, 2, 4, 6, 8], [1, 3, 5, 7]),
     ("interp_aleks", 2, [0, 4, 8], [2, 6]), ("misc", 2, [0, 4, 8], [])],
)  # fmt: skip
def test_deformable_3dgs_moves_and_scales_hypernerf_captures(tmp_path, above, shrunk, train, test):
    """scene/dataset_readers.py, readNerfiesCameras: another frame, time, size and split than those of 4DGaussians."""
    path, center, scale = hypernerf(tmp_path / above / "s", rgb=False), np.array([0.5, -1.0, 2.0]), 0.25
    with pytest.raises(SceneError, match="time_id"):
        load_scene(path, {"is_6dof": False})
    (path / "metadata.json").write_text(json.dumps({f"{i:06d}": {"warp_id": i, "time_id": 3 * i} for i in range(9)}))
    (path / "scene.json").write_text(json.dumps({"scale": scale, "center": center.tolist(), "near": 0.1, "far": 2.0}))
    cfg = {"is_6dof": False, "is_blender": False, "eval": True, "resolution": -1}
    scene = load_scene(path, cfg)
    assert [[int(camera.name) for camera in scene.split(split)] for split in ("train", "test")] == [train, test]
    for camera in scene.cameras:
        pose = poses(9)[int(camera.name)]
        turn = (pose[:, :3] @ np.diag([1.0, -1, -1])).T
        wanted = -scale * turn @ (pose[:, 3] - center)
        assert np.allclose(camera.viewmat[:3, :3].numpy(), turn) and np.allclose(camera.viewmat[:3, 3].numpy(), wanted)
        assert (camera.width, camera.fx, camera.time) == (536 // shrunk, 500.0 / shrunk, int(camera.name) / 8)
    assert {camera.split for camera in load_scene(path, {**cfg, "eval": False}).cameras} == {"train"}


@pytest.mark.parametrize(
    ("tests", "trains"),
    [([2, 6], [0, 4, 8]), ([], [0, 4, 8]), ([1, 3, 5, 7], [0, 2, 4, 6, 8]), ([0, 8], [1, 2, 3, 4, 5, 6, 7, 9])],
    ids=["interp", "misc", "vrig", "COLMAP"],
)  # fmt: skip
def test_the_cameras_json_of_a_hypernerf_capture_has_its_test_views_first(tmp_path, tests, trains):
    """Of Deformable 3D Gaussians (scene/__init__.py): another number of them than of a COLMAP scene, or none."""
    cameras = [replace(view, name=f"{number:06d}") for number, view in zip([*tests, *trains], tiny.cameras(len(tests + trains)), strict=True)]
    path = write_cameras(tmp_path / "cameras.json", cameras)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = read_cameras(path, {"is_6dof": False, "eval": True})
    assert [int(camera.name) for camera in found if camera.split == "test"] == tests


@pytest.fixture
def capture(tmp_path):
    """Of HyperNeRF, as Deformable 3D Gaussians needs it."""
    path = hypernerf(tmp_path / "interp_aleks/s")
    (path / "metadata.json").write_text(json.dumps({f"{i:06d}": {"warp_id": i, "time_id": 3 * i} for i in range(9)}))
    (path / "scene.json").write_text(json.dumps({"scale": 0.25, "center": [0.5, -1.0, 2.0]}))
    return path


def test_photographs_judge_a_deformable_checkpoint_in_its_own_frame(capture, tmp_path):
    """`evaluate`, `tradeoff`, and `adapt` with `--images`; at their full size, whatever `resolution` it was trained at."""
    path, folder = capture, moving.write_deformable(tmp_path / "model")
    wanted = load_scene(path, {"is_6dof": False}).cameras
    (folder / "cfg_args").write_text((folder / "cfg_args").read_text().replace("(", "(resolution=2, "))
    base = Base(folder)
    judged = scene(base, path)
    assert [camera.size for camera in judged.cameras] == [camera.size for camera in wanted] == [(480, 268)] * 5
    assert all(torch.equal(one.viewmat, other.viewmat) for one, other in zip(judged.cameras, wanted, strict=True))
    assert [camera.time for camera in judged.cameras] == [camera.time for camera in wanted]
    assert scene(Base(tiny.folder(tmp_path / "still")), path).digest() == load_scene(path).digest()


def test_python_takes_the_path_of_photographs_as_commands_do(capture, tmp_path):
    model = wrap_model(moving.write_deformable(tmp_path / "model"), cameras=capture, backend="reference")
    right, other = load_scene(capture, {"is_6dof": False}), load_scene(capture)
    assert all(torch.equal(one.viewmat, wanted.viewmat) for one, wanted in zip(model.cameras, right.cameras, strict=True))
    assert [scene_of(model.model, images).digest() for images in (capture, str(capture), right)] == [right.digest()] * 3
    assert model.place(right) is right
    with pytest.raises(SettingsError, match="was read as 4DGaussians does, and Deformable 3D Gaussians, which trained this checkpoint, takes other"):
        model.adapt(2, images=other)
    with pytest.raises(SettingsError, match="give the path itself as images or cameras"):
        wrap_model(model.model, cameras=other)


def test_broken_ones_are_refused_in_one_sentence(tmp_path):
    path = dynerf(tmp_path / "d")
    (path / "cam03.mp4").unlink()
    with pytest.raises(SceneError, match=r"3 videos.*4 cameras"):
        load_scene(path)
    (path / "poses_bounds.npy").write_bytes(b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (900000000, 17), }\n")
    with pytest.raises(SceneError, match="is not an array"):
        load_scene(path)
    path = hypernerf(tmp_path / "h")
    (path / "camera/000004.json").write_text('{"orientation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}')
    with pytest.raises(SceneError, match="orientation: is not a rotation"):
        load_scene(path)


def test_a_camera_file_that_is_no_object_is_refused(tmp_path):
    path = hypernerf(tmp_path / "h")
    (path / "camera/000004.json").write_text("0.5")
    with pytest.raises(SceneError, match=r"000004\.json: holds no values by name"):
        load_scene(path)


def test_an_array_whose_header_is_cut_off_is_refused(tmp_path):
    path = dynerf(tmp_path / "d") / "poses_bounds.npy"
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"'shape': (4, 17)", b"'shape': (4, 17 "))
    with pytest.raises(SceneError, match="is not an array"):
        load_scene(path.parent)
