"""cameras.json: views, splits and sizes as the training had them, and a sentence for what is broken."""

import math
import warnings

import pytest
import torch
from scene_files import ROTATION, TRANSLATION, entry, write_json

from mipmap_plugin.errors import SceneError
from mipmap_plugin.scenes import load_scene, read_cameras
from mipmap_plugin.scenes.cameras_json import count_test_cameras
from mipmap_plugin.scenes.training_options import trained_size


def test_a_known_entry_gives_the_known_view(tmp_path):
    (camera,) = read_cameras(write_json(tmp_path / "cameras.json", [entry()]))
    torch.testing.assert_close(camera.viewmat[:3, :3], torch.tensor(ROTATION, dtype=torch.float64))
    torch.testing.assert_close(camera.viewmat[:3, 3], torch.tensor(TRANSLATION, dtype=torch.float64), atol=1e-8, rtol=0)
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (64, 48, 70, 72, 32, 24)
    assert (camera.name, camera.split) == ("a", "train")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx": None}, r"entry 0 \(a\): has no 'fx'"),
        ({"img_name": None}, "entry 0: has no 'img_name'"),
        ({"position": [0, math.nan, 0]}, "position: holds NaN"),
        ({"position": [0, 0]}, r"position: has shape \[2\] instead of \[3\]"),
        ({"rotation": [[1, 0, 0], [0, 1], [0, 0, 1]]}, "rotation: is not made of numbers"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, r"rotation: is not a rotation \(determinant -1"),
        ({"rotation": [[2, 0, 0], [0, 0.5, 0], [0, 0, 1]]}, "rotation: is not a rotation"),
        ({"width": 0}, "width: is 0 but must be above 0"),
        ({"height": 4.5}, "height: is 4.5 but must be a whole number"),
        ({"fy": -1.0}, "fy: is -1 but must be above 0"),
        ({"fx": "wide"}, "fx: is not made of numbers"),
    ],
)
def test_a_broken_entry_is_named(tmp_path, changes, message):
    with pytest.raises(SceneError, match=message):
        read_cameras(write_json(tmp_path / "cameras.json", [entry(**changes)]))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"{}", "is not a list of cameras"),
        (b"[]", "lists no cameras"),
        (b"[3]", "entry 0: is not a camera"),
        (b"[{", "is not JSON"),
        (b"\xff\xfe\x00", "is not JSON"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
    ],
)
def test_a_file_that_is_no_camera_list_is_named(tmp_path, content, message):
    path = tmp_path / "cameras.json"
    path.write_bytes(content)
    with pytest.raises(SceneError, match=message):
        read_cameras(path)


def test_an_absent_file_is_named(tmp_path):
    with pytest.raises(SceneError, match="cannot be read"):
        read_cameras(tmp_path / "cameras.json")


@pytest.mark.parametrize(("lod", "tests"), [(3, [0, 1, 2, 3]), (50, list(range(51, 60)))])
def test_the_option_lod_of_scaffold_holds_out_the_first_or_the_last_views_by_name(tmp_path, lod, tests):
    """Each view behind them has the number that its appearance has in the model."""
    trained = [number for number in range(60) if number not in tests]
    path = write_json(tmp_path / "cameras.json", [entry(img_name=f"{number:03}") for number in (*tests, *trained)])
    cameras = read_cameras(path, {"eval": True, "lod": lod})
    assert [int(camera.name) for camera in cameras if camera.split == "test"] == tests
    assert [(camera.index, int(camera.name)) for camera in cameras if camera.split == "train"] == list(enumerate(trained))


@pytest.mark.parametrize(
    ("names", "count"),
    [(["r_0", "r_1", "r_0", "r_1", "r_2"], 2), ([str(i) for i in range(16)], 2), ([str(i) for i in range(17)], 3), (["a"], 1)],
)
def test_leading_cameras_are_for_testing(names, count):
    assert count_test_cameras(names) == count


@pytest.mark.parametrize(
    "names",
    [
        ["frame"] * 100,  # frame.0001.jpg, frame.0002.jpg, ...
        sorted(f"{frame:04d}" for frame in range(40) for _ in range(10)),  # of a rig, in a folder for each of its ten cameras
        sorted([f"IMG_{number}" for number in range(1000, 1080)] + [f"IMG_{number}" for number in range(1050, 1160)]),  # of two phones
    ],
)
def test_names_that_repeat_because_they_are_cut_say_which_cameras_are_for_testing(names):
    """INRIA cut names of photographs off at their first dot, and left out their folders, until October 2024."""
    tests = names[::8]
    assert count_test_cameras([*tests, *(name for place, name in enumerate(names) if place % 8)]) == len(tests)


def test_blender_cameras_of_several_folders_are_for_testing_up_to_the_first_repeated_name():
    moments = [f"{moment:04d}" for moment in range(30)]
    assert count_test_cameras(moments * 5) == 30


@pytest.mark.parametrize(("held_out", "splits"), [(False, ["train"] * 4), (True, ["test", "test", "train", "train"])])
def test_with_eval_the_leading_cameras_are_for_testing_and_without_none(tmp_path, held_out, splits):
    path = write_json(tmp_path / "cameras.json", [entry(img_name=name) for name in "abab"])
    assert [camera.split for camera in read_cameras(path, {"eval": held_out})] == splits


@pytest.mark.parametrize(
    ("names", "tests"),
    [
        ([f"{i:03}" for i in range(17)], ["000", "008", "016"]),  # sorted by name
        (["000", "008", "016", *(f"{i:03}" for i in range(17) if i % 8)], ["000", "008", "016"]),  # as INRIA writes it
        ([f"{split}_{i:03}" for split, n in (("test", 3), ("train", 14)) for i in range(n)], ["test_000", "test_001", "test_002"]),
        ([f"{i:03}" for i in range(5)], ["000"]),
    ],
    ids=["sorted", "INRIA's", "named after their split", "few"],
)
def test_the_order_of_names_tells_which_cameras_are_for_testing(tmp_path, names, tests):
    path = write_json(tmp_path / "cameras.json", [entry(img_name=name) for name in names])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cameras = read_cameras(path, {"eval": True})
    assert [camera.name for camera in cameras if camera.split == "test"] == tests
    assert [camera.index for camera in cameras if camera.split == "train"] == list(range(len(names) - len(tests)))


def test_an_order_that_does_not_tell_the_test_cameras_is_told_of(tmp_path):
    path = write_json(tmp_path / "cameras.json", [entry(img_name=str(i)) for i in range(17)])  # by number: 10 is before 2 where names are sorted
    with pytest.warns(UserWarning, match="neither in the order that 3DGS writes nor sorted by name, so the first 3 of 17 are taken as the test"):
        cameras = read_cameras(path, {"eval": True})
    assert [camera.name for camera in cameras if camera.split == "test"] == ["0", "1", "2"]


def test_a_capture_sorted_by_name_holds_out_what_its_photographs_do(shared_data):
    cameras = read_cameras(shared_data / "checkpoints/captures/bird_272/cameras.json", {"eval": True})
    assert [camera.name for camera in cameras if camera.split == "test"][:3] == ["001", "009", "017"]


@pytest.mark.parametrize(
    ("cfg", "size"),
    [
        ({}, (5025, 3312)),
        ({"resolution": 1}, (5025, 3312)),
        ({"resolution": 2}, (2512, 1656)),  # 2512.5 rounds to even, as Python does
        ({"resolution": 8}, (628, 414)),
        ({"resolution": -1}, (1600, 1054)),  # 1054.57 is cut off
        ({"resolution": 400}, (400, 263)),  # 263.64 is cut off
        ({"resolution": -1, "images": "images_4"}, (1256, 828)),
        ({"resolution": 1, "images": "images_2"}, (2513, 1656)),  # ImageMagick rounds 2512.5 up
        ({"resolution": 2, "images": "images_2"}, (1256, 828)),
        ({"resolution": 1, "images": "images"}, (5025, 3312)),
    ],
)
def test_training_size_of_flowers(cfg, size):
    assert trained_size(5025, 3312, cfg) == size


@pytest.mark.parametrize(
    ("size", "cfg", "trained"),
    [
        ((1600, 900), {"resolution": -1}, (1600, 900)),  # not capped
        ((100, 3), {"resolution": 10}, (10, 1)),
        ((3, 3), {"resolution": 8}, (1, 1)),
        ((3, 3), {"images": "images_8"}, (1, 1)),
    ],
)
def test_no_side_is_enlarged_and_none_becomes_0(size, cfg, trained):
    assert trained_size(*size, cfg) == trained


@pytest.mark.parametrize("resolution", [0, -2, "half", None])
def test_a_resolution_that_is_none_is_refused(resolution):
    with pytest.raises(SceneError, match="is no training size"):
        trained_size(100, 100, {"resolution": resolution})


def test_flowers_are_read_at_their_training_size(shared_data):
    cameras = read_cameras(shared_data / "checkpoints/flowers_r8/cameras.json", {"resolution": 8, "eval": False, "images": "images"})
    assert {camera.size for camera in cameras} == {(414, 628)}
    assert cameras[0].fx == pytest.approx(4328.590804346088 * 628 / 5025)
    assert cameras[0].fy == pytest.approx(4285.457130435278 / 8)


def test_a_real_blender_base_has_200_test_views(shared_data):
    scene = load_scene(shared_data / "checkpoints/bases/lego_200", {"resolution": -1, "eval": True, "images": "images"})
    assert (len(scene.split("test")), len(scene.split("train"))) == (200, 100)
    assert {camera.size for camera in scene.cameras} == {(200, 200)}
