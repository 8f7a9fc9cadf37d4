"""Cameras as other tools than INRIA's write them: what their files say beyond its format is not lost."""

import json
import warnings
from dataclasses import replace

import pytest
import tiny
import torch

from mipmap_plugin.errors import SceneError
from mipmap_plugin.scenes import Scene, load_scene, read_cameras, read_transforms, write_cameras
from mipmap_plugin.wrap import wrap_model

POSE = [[1, 0, 0, 1.0], [0, 1, 0, 2.0], [0, 0, 1, 3.0], [0, 0, 0, 1]]


def test_a_principal_point_in_a_cameras_json_is_read(tmp_path):
    """Descendants of 3DGS write it; without it the picture would be shifted."""
    cropped, centered = replace(tiny.cameras(1)[0], cx=11.0, cy=15.5), replace(tiny.cameras(2)[1], name="b")
    path = write_cameras(tmp_path / "cameras.json", [cropped, centered])
    assert [(camera.cx, camera.cy) for camera in read_cameras(path)] == [(11.0, 15.5), (centered.cx, centered.cy)]
    assert "cx" not in json.loads(path.read_text())[1]
    halved = read_cameras(path, {"resolution": 2})[0]
    assert (halved.width, halved.cx, halved.cy) == (cropped.width // 2, 5.5, 7.75)


@pytest.mark.parametrize(
    ("cx", "cy", "said"),
    [(0.5, 1.0, ": has cx 0.5 and cy 1, but must have pixels"), (-0.02, None, ": has cx -0.02, but must"), ("left", 11.0, ", cx: is not")],
)
def test_a_principal_point_in_other_units_is_refused(tmp_path, cx, cy, said):
    path = write_cameras(tmp_path / "cameras.json", [replace(tiny.cameras(1)[0], cx=11.0, cy=15.0)])
    path.write_text(path.read_text().replace("11.0", json.dumps(cx)).replace("15.0", json.dumps(cy)))
    with pytest.raises(SceneError, match=rf"entry 0 \(view_0\){said}"):
        read_cameras(path)


def test_a_principal_point_may_lie_at_an_edge(tmp_path):
    """A tile of a large picture has it anywhere."""
    path = write_cameras(tmp_path / "cameras.json", [replace(tiny.cameras(1)[0], cx=0.5, cy=17.0)])
    assert [(camera.cx, camera.cy) for camera in read_cameras(path)] == [(0.5, 17.0)]


def transforms(folder, **facts):
    frames = [{"file_path": f"images/{name}.JPG", "transform_matrix": POSE} for name in ("a", "b.1", "c")]
    path = folder / "transforms.json"
    path.write_text(json.dumps({"w": 40, "h": 30, "fl_x": 50.0, "frames": frames, **facts}))
    return path


def test_a_transforms_file_may_list_the_frames_of_each_split(tmp_path):
    lists = {"train_filenames": ["images/a.JPG", "images/c.JPG"], "val_filenames": ["images/b.1.JPG"], "test_filenames": ["images/b.1.JPG"]}
    assert [camera.split for camera in read_transforms(transforms(tmp_path, **lists)).cameras] == ["train", "test", "train"]
    assert [camera.split for camera in read_transforms(transforms(tmp_path)).cameras] == ["train"] * 3


def test_names_in_the_lists_of_a_transforms_file_may_be_written_otherwise(tmp_path):
    """nerfstudio compares paths, for which `./a` is `a`; before, all views were for testing."""
    lists = {"train_filenames": ["./images/a.JPG", "images\\c.JPG"]}
    assert [camera.split for camera in read_transforms(transforms(tmp_path, **lists)).cameras] == ["train", "test", "train"]


@pytest.mark.parametrize(
    ("cfg", "size"),
    [({"resolution": 2}, (15, 20)), ({"resolution": 10, "images": "images_4"}, (7, 10)), ({"resolution": 2, "kplanes_config": {}}, (30, 40))],
)
def test_3dgs_trains_on_blender_scenes_at_the_size_of_r_and_centered(tmp_path, cfg, size):
    """utils/camera_utils.py, loadCam: -r counts for all scenes. 4DGaussians has the option, and does not use it."""
    transforms(tmp_path, cx=19.0).rename(tmp_path / "transforms_train.json")
    [camera, *_] = load_scene(tmp_path, cfg).cameras
    assert (camera.size, camera.cx, camera.fx) == (size, size[1] / 2, 50 * size[1] / 40)
    assert load_scene(tmp_path).cameras[0].cx == 19.0


def test_4dgaussians_divides_times_by_the_last(tmp_path):
    """scene/dataset_readers.py, read_timeline: of training and test frames together. Deformable 3D Gaussians takes them as they are."""
    for split, time in (("train", 3), ("test", 12)):
        frame = {"file_path": split, "transform_matrix": POSE, "time": time}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps({"w": 8, "h": 8, "fl_x": 9, "frames": [frame]}))
    assert [camera.time for camera in load_scene(tmp_path, {"kplanes_config": {}}).cameras] == [0.25, 1.0]
    assert [camera.time for camera in load_scene(tmp_path, {"is_6dof": False}).cameras] == [3.0, 12.0]


def test_a_view_has_the_same_name_with_its_photograph_and_without(tmp_path):
    path = transforms(tmp_path)
    names = [camera.name for camera in read_transforms(path).cameras]
    (tmp_path / "images").mkdir()
    for name in names:
        tiny.write_image(tmp_path / "images" / f"{name}.JPG", tiny.torch.zeros(30, 40, 3))
    with_photographs = read_transforms(path)
    assert len(with_photographs.images) == 3
    assert names == [camera.name for camera in with_photographs.cameras] == ["a", "b.1", "c"]


@pytest.mark.parametrize(("size", "fits"), [((40, 30), True), ((13, 10), True), ((5, 4), True), ((30, 40), False), ((40, 22), False)])
def test_a_photograph_that_was_turned_or_cropped_is_refused(tmp_path, size, fits):
    """A camera that followed its shape would show a distorted scene."""
    path, (width, height) = transforms(tmp_path), size
    (tmp_path / "images").mkdir()
    tiny.write_image(tmp_path / "images/a.JPG", tiny.torch.zeros(height, width, 3))
    if fits:
        assert read_transforms(path).cameras[0].size == (height, width)
        return
    with pytest.raises(SceneError, match=rf"frame 0 \(a\): its camera is of 40 x 30 px, but the photograph has {width} x {height} px"):
        read_transforms(path)


@pytest.mark.parametrize("name", ["Nerstudio 1.1.5", "Nerfstudio"])
def test_cameras_of_a_capture_are_in_another_frame_than_an_export(tmp_path, name):
    """`ns-export gaussian-splat` and gsplat leave splats in the frame of the training."""
    made, scene = tiny.ply(tmp_path / "made.ply"), tiny.scene(tmp_path / "scene", train=tiny.cameras(2))
    exported = tmp_path / "splat.ply"
    exported.write_bytes(made.read_bytes().replace(b"element vertex", b"comment Generated by " + name.encode() + b"\nelement vertex", 1))
    with pytest.warns(UserWarning, match=r"splat.ply is in the frame that nerfstudio trained in.*adapt the folder of the run"):
        wrap_model(exported, cameras=scene)
    of_gsplat = tmp_path / "run/ply/point_cloud_6999.ply"
    of_gsplat.parent.mkdir(parents=True)
    of_gsplat.write_bytes(made.read_bytes())
    (tmp_path / "run/cfg.yml").write_text("normalize_world_space: true\n")
    with pytest.warns(UserWarning, match=r"point_cloud_6999.ply is in the frame that gsplat trained in"):
        wrap_model(of_gsplat, cameras=scene)
    (tmp_path / "run/cfg.yml").write_text("normalize_world_space: false\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wrap_model(of_gsplat, cameras=scene)
        wrap_model(made, cameras=scene)
        wrap_model(exported, cameras=write_cameras(tmp_path / "own.json", tiny.cameras(2)))


def test_cameras_of_a_capture_are_in_another_frame_than_what_opensplat_writes(tmp_path):
    """It centers and scales the cameras' world, and writes a cameras.json that fits."""
    made, scene = tiny.ply(tmp_path / "made.ply"), tiny.scene(tmp_path / "scene", train=tiny.cameras(2))
    comment = b"comment Generated by opensplat at iteration 30000\nelement vertex"
    made.write_bytes(made.read_bytes().replace(b"element vertex", comment, 1))
    with pytest.warns(UserWarning, match=r"in the frame that OpenSplat trained in.*give the cameras.json that it wrote beside its PLY, unless"):
        wrap_model(made, cameras=scene)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wrap_model(made, cameras=write_cameras(tmp_path / "own.json", tiny.cameras(2)))


@pytest.mark.parametrize(("width", "told"), [(1600, False), (1601, True)])
def test_a_capture_larger_than_trainings_take_is_told_of_where_nothing_says_their_size(tmp_path, width, told):
    """By default 3DGS makes pictures 1600 px wide (utils/camera_utils.py), Brush at most 1920 px long (crates/brush-dataset/src/config.py)."""
    cameras = tuple(camera.resized(width, 1200) for camera in tiny.cameras(2))
    scene, ply = Scene(cameras, {}, tmp_path, points=torch.zeros(1, 3)), tiny.ply(tmp_path / "base.ply")
    folder = tiny.folder(tmp_path / "model")
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        wrap_model(ply, cameras=list(cameras))
        wrap_model(folder, cameras=scene)  # has cfg_args
        assert not found
        wrap_model(ply, cameras=scene)
    assert [f"views of {width} x 1200 px, which is taken to be the size of the training" in str(each.message) for each in found] == [True] * told
