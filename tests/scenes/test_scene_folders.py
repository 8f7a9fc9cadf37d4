"""What a scene is loaded from: folders, files and the images that its cameras name."""

import pytest
import tiny
import torch
from scene_files import entry, frame, save_image, write_json

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SceneError, SettingsError
from mipmap_plugin.scenes import load_scene, model_cameras, read_transforms
from mipmap_plugin.scenes.base import sizes_of

WHITE = (1.0, 1.0, 1.0)


def test_a_cameras_json_alone_says_what_it_lacks(tmp_path):
    path = write_json(tmp_path / "cameras.json", [entry()])
    scene = load_scene(path)
    assert (scene.source, scene.images) == (path, {})
    assert "without cfg_args" in scene.notes[0]


@pytest.mark.parametrize("given", ["", "cameras.json"])
def test_cameras_of_a_model_folder_have_the_size_and_the_split_of_its_training(tmp_path, given):
    """They are given with a lone file that was exported from it; the options of the checkpoint itself come first."""
    write_json(tmp_path / "cameras.json", [entry(), entry(id=1, img_name="b")])
    (tmp_path / "cfg_args").write_text("Namespace(resolution=2, eval=True)")
    scene = load_scene(tmp_path / given)
    assert [(camera.size, camera.split) for camera in scene.cameras] == [((24, 32), "test"), ((24, 32), "train")] and scene.notes == []
    assert {camera.size for camera in load_scene(tmp_path / given, {"resolution": 4}).cameras} == {(12, 16)}


def test_damaged_options_beside_cameras_are_named(tmp_path):
    path = write_json(tmp_path / "cameras.json", [entry()])
    (tmp_path / "cfg_args").write_text("Namespace(")
    with pytest.raises(SceneError, match=r"cfg_args is not a plain .* mend it, or take it away"):
        load_scene(path)


def test_a_checkpoint_may_come_with_cameras_or_without(tmp_path):
    assert model_cameras(None) == model_cameras(tmp_path) == []
    write_json(tmp_path / "cameras.json", [entry()])
    assert [camera.size for camera in model_cameras(tmp_path, {"resolution": 2})] == [(24, 32)]


def test_a_transforms_file_may_have_any_name(tmp_path):
    scene = load_scene(write_json(tmp_path / "polycam.json", {"fl_x": 9.0, "w": 8, "h": 8, "frames": [frame()]}))
    assert [camera.size for camera in scene.cameras] == [(8, 8)]
    with pytest.raises(SceneError, match=r"other.json: has no cameras: neither the frames of a transforms.json nor the list of a cameras.json"):
        load_scene(write_json(tmp_path / "other.json", {"fx": 9.0}))


@pytest.mark.parametrize("name", ["cameras.xml", "poses.csv", "bundle.out"])
def test_cameras_in_formats_that_are_not_read_are_refused(tmp_path, name):
    (tmp_path / name).write_text("<document/>")
    with pytest.raises(SceneError, match=rf"{name}: is no file of cameras that is read here .*; export them as one of these"):
        load_scene(tmp_path / name)


def test_a_file_of_splats_is_no_scene(tmp_path):
    with pytest.raises(SceneError, match=r"a.ply: is no file of cameras .*; this PLY has no camera in it: give the cameras of its scene$"):
        load_scene(tiny.ply(tmp_path / "a.ply"))


def test_a_file_of_a_colmap_model_names_its_folder(tmp_path):
    (tmp_path / "images.bin").write_bytes(b"\0")
    with pytest.raises(SceneError, match=f"give its folder, {tmp_path}$"):
        load_scene(tmp_path / "images.bin")


def test_cameras_one_level_above_or_below_are_named(tmp_path):
    (tmp_path / "captures/desk/images").mkdir(parents=True)
    write_json(tmp_path / "captures/desk/transforms.json", {})
    for given in (".", "captures", "captures/desk/images"):
        with pytest.raises(SceneError, match=f"holds neither .*, such as {tmp_path / 'captures/desk'}$"):
            load_scene(tmp_path / given)


@pytest.mark.parametrize(("file", "maker"), [("keyframes/cameras/1.json", "Polycam"), ("rgbd/0.jpg", "Record3D"), ("depth/0.exr", "Record3D")])
def test_a_capture_that_no_training_takes_as_it_is_names_what_to_give(tmp_path, file, maker):
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).touch()
    with pytest.raises(SceneError, match=f"is a capture as {maker} exports it.*give what the checkpoint was trained on, such as .* ns-process-data"):
        load_scene(tmp_path)


@pytest.mark.parametrize(("given", "said"), [("", r"holds neither cameras\.json nor transforms files"), ("gone", "there is no such file or folder")])
def test_an_empty_folder_and_an_absent_path_are_refused(tmp_path, given, said):
    with pytest.raises(SceneError, match=said):
        load_scene(tmp_path / given)


def test_an_unknown_split_is_refused(tmp_path):
    with pytest.raises(SettingsError, match="no split 'val'"):
        load_scene(write_json(tmp_path / "cameras.json", [entry()])).split("val")


def test_a_zoomed_camera_has_no_image(tmp_path):
    save_image(tmp_path / "train/r_0.png")
    scene = read_transforms(write_json(tmp_path / "transforms_train.json", {"camera_angle_x": 0.8, "frames": [frame()]}))
    assert scene.image(scene.cameras[0], WHITE).shape == (6, 8, 3)
    with pytest.raises(SceneError, match="'r_0' has no image"):
        scene.image(scene.cameras[0].zoomed(0.5), WHITE)


def test_lego_is_read_on_white_at_full_size(shared_data):
    scene = load_scene(shared_data / "images/lego")
    image = scene.image(scene.split("test")[0], WHITE)
    assert (image.shape, image.dtype) == ((800, 800, 3), torch.float32)
    assert image[0, 0].tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        ([(272, 480), (272, 480)], "272 x 480 px"),
        ([(272, 480), (480, 272)], "272 x 480 and 480 x 272 px"),
        ([(816, 1440), (272, 480), (480, 272)], "272 x 480 to 816 x 1440 px"),
    ],
    ids=["one size", "portrait and landscape", "two resolutions too"],
)
def test_sizes_of_cameras_are_told(sizes, said):
    assert sizes_of([Camera(*size, 300.0, 300.0, 100.0, 100.0, torch.eye(4)) for size in sizes]) == said
