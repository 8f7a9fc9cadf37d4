"""Cameras and images from files: real ones agree with each other, broken ones raise an error of one sentence."""

import json
import math
import struct
import warnings
import zlib

import numpy as np
import pytest
import tiny
import torch
from PIL import Image

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import OutputExists, SceneError, SettingsError, ShapeError
from mipmap_plugin.formats.images import composite, image_size, read_image, write_image
from mipmap_plugin.scenes import load_scene, model_cameras, read_cameras, read_transforms
from mipmap_plugin.scenes.base import sizes_of
from mipmap_plugin.scenes.cameras_json import count_test_cameras, trained_size

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)

# The world-to-camera rotation of quaternion (0.9, 0.1, -0.2, 0.3), normalized, and a translation, evaluated by hand.
ROTATION = [[0.726315789, -0.610526316, -0.315789474], [0.526315789, 0.789473684, -0.315789474], [0.442105263, 0.063157895, 0.894736842]]
TRANSLATION = [0.5, -0.25, 4.0]


def entry(**changes) -> dict:
    turned = [list(column) for column in zip(*ROTATION, strict=True)]
    known = {"id": 0, "img_name": "a", "width": 64, "height": 48, "position": [-2.0, 0.25, -3.5], "rotation": turned, "fy": 72.0, "fx": 70.0}
    return {key: value for key, value in {**known, **changes}.items() if value is not None}


def frame(**changes) -> dict:
    pose = [[1, 0, 0, 1.0], [0, 1, 0, 2.0], [0, 0, 1, 3.0], [0, 0, 0, 1]]
    return {key: value for key, value in {"file_path": "./train/r_0", "transform_matrix": pose, **changes}.items() if value is not None}


def write_json(path, content):
    path.write_text(json.dumps(content))
    return path


def save_image(path, width=8, height=6, mode="RGB"):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new(mode, (width, height)).save(path)
    return path


def gray_png_16(path, values):
    """A 16-bit gray PNG, written by hand so that the reader's library does not test itself."""
    height, width = values.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    parts = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    chunks = (struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    return path


# cameras.json


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


@pytest.mark.parametrize(
    ("names", "count"),
    [(["r_0", "r_1", "r_0", "r_1", "r_2"], 2), ([str(i) for i in range(16)], 2), ([str(i) for i in range(17)], 3), (["a"], 1)],
)
def test_leading_cameras_are_for_testing(names, count):
    assert count_test_cameras(names) == count


def test_without_eval_every_camera_is_for_training(tmp_path):
    path = write_json(tmp_path / "cameras.json", [entry(img_name=name) for name in "abab"])
    assert [camera.split for camera in read_cameras(path, {"eval": False})] == ["train"] * 4


def test_with_eval_the_leading_cameras_are_for_testing(tmp_path):
    path = write_json(tmp_path / "cameras.json", [entry(img_name=name) for name in "abab"])
    assert [camera.split for camera in read_cameras(path, {"eval": True})] == ["test", "test", "train", "train"]


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
        ({"resolution": 2, "images": "images_2"}, (1256, 828)),
        ({"resolution": 1, "images": "images"}, (5025, 3312)),
    ],
)
def test_training_size_of_flowers(cfg, size):
    assert trained_size(5025, 3312, cfg) == size
    assert trained_size(1600, 900, {"resolution": -1}) == (1600, 900)  # which is not capped


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


# transforms


def test_both_camera_files_of_lego_give_the_same_views(shared_data):
    base = load_scene(shared_data / "checkpoints/bases/lego_200", {"resolution": -1, "eval": True})
    photos = load_scene(shared_data / "images/lego")
    known = {(camera.split, camera.name): camera for camera in base.cameras}
    assert len(photos.cameras) == 125
    for camera in photos.cameras:
        trained = known[camera.split, camera.name]
        torch.testing.assert_close(camera.viewmat, trained.viewmat, atol=1e-5, rtol=0)
        resized = camera.resized(200, 200)
        assert (resized.fx, resized.fy, resized.cx, resized.cy) == pytest.approx((trained.fx, trained.fy, trained.cx, trained.cy), rel=1e-6)


def test_the_older_pose_formula_gives_the_same_views_of_lego(shared_data):
    for file in ("transforms_train.json", "transforms_test.json"):
        frames = json.loads((shared_data / "images/lego" / file).read_text())["frames"]
        scene = read_transforms(shared_data / "images/lego" / file)
        for camera, listed in zip(scene.cameras, frames, strict=True):
            w2c = np.linalg.inv(np.array(listed["transform_matrix"]))
            rotation = w2c[:3, :3].T * [1, -1, -1]  # -R with the first column negated, stored transposed
            older = np.concatenate([rotation.T, -w2c[:3, 3:]], axis=1)
            torch.testing.assert_close(camera.viewmat[:3], torch.from_numpy(older), atol=1e-5, rtol=0)


def test_an_off_center_pose_is_inverted_exactly(tmp_path):
    save_image(tmp_path / "train/r_0.png")
    scene = read_transforms(write_json(tmp_path / "transforms_train.json", {"camera_angle_x": 1.0, "frames": [frame()]}))
    expected = torch.tensor([[1, 0, 0, -1], [0, -1, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(scene.cameras[0].viewmat, expected)


@pytest.mark.parametrize("listed", ["./train/r_0", "train/r_0.png", "train\\r_0"])
def test_a_path_may_lack_its_extension(tmp_path, listed):
    image = save_image(tmp_path / "train/r_0.png")
    write_json(tmp_path / "transforms_train.json", {"camera_angle_x": 0.8, "frames": [frame(file_path=listed)]})
    scene = load_scene(tmp_path)
    (camera,) = scene.cameras
    assert scene.images[camera].samefile(image)
    assert (camera.name, camera.width, camera.height) == ("r_0", 8, 6)
    assert camera.fx == camera.fy == pytest.approx(4 / math.tan(0.4))


def test_absent_images_are_counted_and_left_out(tmp_path):
    save_image(tmp_path / "train/r_0.png")
    frames = [frame(), frame(file_path="train/r_1"), frame(file_path="train/r_2")]
    scene = read_transforms(write_json(tmp_path / "transforms_train.json", {"camera_angle_x": 0.8, "frames": frames}))
    assert len(scene.cameras) == 1
    assert scene.notes == ["transforms_train.json: 2 listed images are absent; 2 cameras are left out because the file has no w and h"]


def test_a_stated_size_makes_views_without_images(tmp_path):
    scene = read_transforms(write_json(tmp_path / "transforms.json", {"camera_angle_x": 0.8, "w": 40, "h": 30, "frames": [frame()]}))
    assert (scene.cameras[0].size, scene.images) == ((30, 40), {})


def test_without_images_and_size_the_folder_is_refused(tmp_path):
    with pytest.raises(SceneError, match="none of the listed images is there"):
        read_transforms(write_json(tmp_path / "transforms_train.json", {"camera_angle_x": 0.8, "frames": [frame()]}))


def test_absent_images_whose_cameras_stay_are_counted_alone(tmp_path):
    data = {"camera_angle_x": 0.8, "w": 40, "h": 30, "frames": [frame()]}
    assert read_transforms(write_json(tmp_path / "transforms.json", data)).notes == ["transforms.json: 1 listed image is absent"]


def test_the_scale_of_a_cameras_axes_is_left_out(tmp_path):
    """As Blender writes it for a camera that was made smaller; its place is the same."""
    data = {"camera_angle_x": 0.8, "w": 40, "h": 30}
    pose = np.array(frame()["transform_matrix"], dtype=np.float64)
    scaled = pose.copy()
    scaled[:3, :3] *= 1e-3
    expected, found = (
        read_transforms(write_json(tmp_path / f"{name}.json", {**data, "frames": [frame(transform_matrix=matrix.tolist())]})).cameras[0]
        for name, matrix in {"a": pose, "b": scaled}.items()
    )
    torch.testing.assert_close(found.viewmat, expected.viewmat)


def test_a_stated_lens_follows_the_size_of_the_image(tmp_path):
    save_image(tmp_path / "train/r_0.png", 8, 6)
    lens = {"fl_x": 100.0, "fl_y": 90.0, "cx": 17.0, "cy": 11.0, "w": 32, "h": 24}
    (camera,) = read_transforms(write_json(tmp_path / "transforms.json", {**lens, "frames": [frame()]})).cameras
    assert (camera.size, camera.fx, camera.fy, camera.cx, camera.cy) == ((6, 8), 25.0, 22.5, 4.25, 2.75)


def test_a_frames_own_lens_wins(tmp_path):
    data = {"fl_x": 100.0, "w": 32, "h": 24, "frames": [frame(), frame(fl_x=50.0, time=0.25)]}
    first, second = read_transforms(write_json(tmp_path / "transforms.json", data)).cameras
    assert (first.fx, second.fx) == (100.0, 50.0)
    assert (first.time, second.time) == (None, 0.25)


def test_test_and_train_files_are_the_splits(tmp_path):
    for split, names in (("train", "abc"), ("test", "de"), ("val", "f")):
        frames = [frame(file_path=name) for name in names]
        write_json(tmp_path / f"transforms_{split}.json", {"fl_x": 9.0, "w": 4, "h": 4, "frames": frames})
    scene = load_scene(tmp_path)
    assert [camera.name for camera in scene.split("train")] == ["a", "b", "c"]
    assert [camera.name for camera in scene.split("test")] == ["d", "e"]


def test_without_a_test_file_val_is_the_test_split(tmp_path):
    for split in ("train", "val"):
        write_json(tmp_path / f"transforms_{split}.json", {"fl_x": 9.0, "w": 4, "h": 4, "frames": [frame(file_path=split)]})
    assert [camera.name for camera in load_scene(tmp_path).split("test")] == ["val"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"k1": "x"}, r"frame 0 \(r_0\), k1: is not made of numbers"),
        ({"camera_model": "EQUIRECTANGULAR"}, r"has a lens that is not perspective \(EQUIRECTANGULAR\)"),
        ({"camera_model": "EQUIRECTANGULAR", "fl_x": None}, r"has a lens that is not perspective \(EQUIRECTANGULAR\)"),
        ({"fl_x": None}, "has neither 'fl_x' nor 'camera_angle_x'"),
        ({"fl_x": None, "camera_angle_x": 40.0}, "give it in radians"),
        ({"transform_matrix": None}, "has no 'transform_matrix'"),
        ({"transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0]]}, r"transform_matrix: has shape \[2, 4\]"),
        ({"transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]]}, "transform_matrix: is not a rotation"),
        ({"transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, math.inf]]}, "transform_matrix: holds NaN or infinity"),
        ({"file_path": None}, "frame 0: has no 'file_path'"),
    ],
)
def test_a_broken_frame_is_named(tmp_path, changes, message):
    path = write_json(tmp_path / "transforms.json", {"w": 8, "h": 8, "frames": [frame(**{"fl_x": 9.0, **changes})]})
    with pytest.raises(SceneError, match=message):
        read_transforms(path)


def test_zero_distortion_is_no_distortion(tmp_path):
    data = {"fl_x": 9.0, "w": 8, "h": 8, "k1": 0.0, "camera_model": "OPENCV", "frames": [frame()]}
    assert len(read_transforms(write_json(tmp_path / "transforms.json", data)).cameras) == 1


@pytest.mark.parametrize(("content", "lacks"), [([], "no list"), ({"frames": []}, "lists no frames"), ({"frames": 3}, "no list"), ({}, "no list")])
def test_a_file_without_frames_is_named(tmp_path, content, lacks):
    with pytest.raises(SceneError, match=lacks):
        read_transforms(write_json(tmp_path / "transforms.json", content))


# load_scene and Scene


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
    for given in ("captures", "captures/desk/images"):
        with pytest.raises(SceneError, match=f"holds neither .*, such as {tmp_path / 'captures/desk'}$"):
            load_scene(tmp_path / given)


def test_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(SceneError, match=r"holds neither cameras\.json nor transforms files"):
        load_scene(tmp_path)


def test_an_absent_path_is_refused(tmp_path):
    with pytest.raises(SceneError, match="there is no such file or folder"):
        load_scene(tmp_path / "gone")


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


# images


@pytest.mark.parametrize("background", [WHITE, BLACK])
def test_opaque_and_transparent_pixels_are_exact(background):
    values = np.arange(256, dtype=np.uint8).repeat(3).reshape(16, 16, 3)
    for alpha, expected in ((255, values), (0, np.full_like(values, 255 * background[0]))):
        rgba = np.concatenate([values, np.full_like(values[..., :1], alpha)], axis=2)
        assert (composite(rgba, background) == expected).all()


def test_half_transparent_pixels_are_cut_off():
    assert composite(np.array([[[100, 0, 255, 128]]], dtype=np.uint8), WHITE).tolist() == [[[177, 127, 255]]]  # 177.2, 127.0, 255


def test_transparency_shows_the_background(tmp_path):
    image = read_image(save_image(tmp_path / "a.png", mode="RGBA"), (1.0, 0.0, 1.0))
    assert image[0, 0].tolist() == [1, 0, 1]


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGB", "1"])
def test_any_color_mode_is_read(tmp_path, mode):
    assert read_image(save_image(tmp_path / "a.png", mode=mode), BLACK).tolist() == torch.zeros(6, 8, 3).tolist()


def test_jpeg_is_read(tmp_path):
    Image.new("RGB", (8, 8), (200, 100, 50)).save(tmp_path / "a.jpg", quality=95)
    torch.testing.assert_close(read_image(tmp_path / "a.jpg", WHITE)[4, 4] * 255, torch.tensor([200.0, 100.0, 50.0]), atol=2, rtol=0)


def test_16_bit_gray_keeps_its_precision(tmp_path):
    values = np.array([[0, 1, 257], [30000, 65534, 65535]], dtype=np.uint16)
    image = read_image(gray_png_16(tmp_path / "a.png", values), WHITE)
    torch.testing.assert_close(image[..., 1], torch.from_numpy(values.astype(np.float32)) / 65535)


def test_the_size_is_read_from_the_header_alone(tmp_path):
    path = save_image(tmp_path / "a.png", 800, 600)
    path.write_bytes(path.read_bytes()[:50])  # the pixels start at byte 41
    assert image_size(path) == (800, 600)


def test_what_is_written_is_read_back(tmp_path):
    values = torch.tensor([-0.5, 0.0, 0.3, 1.0, 1.5, 0.5 / 255]).reshape(1, 2, 3)
    image = read_image(write_image(tmp_path / "new/a.png", values), WHITE)
    torch.testing.assert_close(image * 255, torch.tensor([0, 0, 76, 255, 255, 0]).reshape(1, 2, 3).float(), atol=1e-4, rtol=0)


def test_nothing_is_overwritten_unasked(tmp_path):
    path = write_image(tmp_path / "a.png", torch.zeros(2, 2, 3))
    with pytest.raises(OutputExists, match="--overwrite"):
        write_image(path, torch.ones(2, 2, 3))
    assert read_image(write_image(path, torch.ones(2, 2, 3), overwrite=True), WHITE).min() == 1


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = write_image(tmp_path / "a.png", torch.zeros(2, 2, 3))

    def full_disk(self, file, **_):
        file.write_bytes(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(Image.Image, "save", full_disk)
    with pytest.raises(OSError, match="No space"):
        write_image(path, torch.ones(2, 2, 3), overwrite=True)
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]
    assert read_image(path, WHITE).max() == 0


@pytest.mark.parametrize(("image", "error"), [(torch.zeros(3, 4, 4), ShapeError), (torch.full((2, 2, 3), math.nan), SceneError)])
def test_what_is_no_image_is_not_written(tmp_path, image, error):
    with pytest.raises(error, match="image"):
        write_image(tmp_path / "a.png", image)
    assert not (tmp_path / "a.png").exists()


def test_an_absent_image_is_named(tmp_path):
    with pytest.raises(SceneError, match="there is no such image"):
        read_image(tmp_path / "a.png", WHITE)


def test_a_text_file_is_no_image(tmp_path):
    (tmp_path / "a.png").write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(SceneError, match="is not an image that Pillow reads"):
        read_image(tmp_path / "a.png", WHITE)


def test_a_truncated_image_is_damaged(tmp_path):
    path = tmp_path / "a.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)).save(path)
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(SceneError, match="the image is damaged"):
        read_image(path, WHITE)


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
