"""transforms files: views, lenses and splits, and a sentence for what is broken."""

import json
import math

import numpy as np
import pytest
import torch
from scene_files import frame, save_image, write_json

from mipmap_plugin.errors import SceneError
from mipmap_plugin.scenes import load_scene, read_transforms


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


def test_masks_are_told_of_for_they_are_not_read(tmp_path):
    frames = {"frames": [frame(mask_path="masks/r_0.png"), frame(mask_path=None)], "test_frames": [frame(mask_path="masks/r_1.png")]}
    scene = read_transforms(write_json(tmp_path / "transforms.json", {"camera_angle_x": 0.8, "w": 40, "h": 30, **frames}))
    masked = "transforms.json: frames that are masked (mask_path): 2; masks are not read, so that what they hide counts like all else"
    assert scene.warnings() == ["transforms.json: 3 listed images are absent", masked]


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


@pytest.mark.parametrize(
    ("own", "focal"),
    [({"fl_x": 20}, (20, 20)), ({"camera_angle_x": math.pi / 2}, (4, 4)), ({"fl_x": 20, "camera_angle_y": math.pi / 2}, (20, 3)),
     ({"fl_x": 20, "fl_y": 21}, (20, 21)), ({"fl_y": 21}, (9, 21))],
)  # fmt: skip
def test_a_frames_own_focal_length_is_not_mixed_with_the_files(tmp_path, own, focal):
    save_image(tmp_path / "train/r_0.png")
    write_json(tmp_path / "transforms.json", {"fl_x": 9, "fl_y": 10, "camera_angle_x": 1.0, "frames": [frame(**own)]})
    [camera] = load_scene(tmp_path).cameras
    assert (camera.fx, camera.fy) == pytest.approx(focal)


def test_a_frames_own_lens_wins(tmp_path):
    data = {"fl_x": 100.0, "w": 32, "h": 24, "frames": [frame(), frame(fl_x=50.0, time=0.25)]}
    first, second = read_transforms(write_json(tmp_path / "transforms.json", data)).cameras
    assert (first.fx, second.fx) == (100.0, 50.0)
    assert (first.time, second.time) == (None, 0.25)


@pytest.mark.parametrize(("own", "focal"), [({"k1": 0.5}, (100.0, 50.0)), ({"w": 64}, (50.0, 50.0)), ({"fl_x": 100.0}, (100.0, 50.0))])
def test_in_a_file_of_nerfstudio_the_files_lens_wins(tmp_path, own, focal):
    """nerfstudio_dataparser.py asks a frame only for what the file lacks; a frame of another size does not fit the file's lens."""
    data = {"camera_model": "OPENCV", "k1": 0.0, "fl_x": 100.0, "w": 32, "h": 32, "frames": [frame(**{"fl_x": 50.0, "fl_y": 50.0, **own})]}
    scene = read_transforms(write_json(tmp_path / "transforms.json", data))
    told = "transforms.json: the intrinsics of 1 of its frames are passed over for those of the file, as in nerfstudio"
    assert (scene.cameras[0].fx, scene.cameras[0].fy) == focal and not scene.lenses
    assert (told in scene.notes) == (own == {"k1": 0.5})


def test_in_a_file_of_nerfstudio_a_frames_own_lens_has_no_part_of_another(tmp_path):
    """Its focal length along y was by the file's angle."""
    data = {"applied_transform": np.eye(4)[:3].tolist(), "camera_angle_x": 0.8, "camera_angle_y": 0.2, "w": 32, "h": 32, "frames": [frame(fl_x=50.0)]}
    [camera] = read_transforms(write_json(tmp_path / "transforms.json", data)).cameras
    assert (camera.fx, camera.fy) == (50.0, 50.0)


def test_a_lens_that_is_said_to_be_a_fisheye_is_one(tmp_path):
    """As instant-ngp says it, which has no `camera_model`."""
    data = {"is_fisheye": True, "k1": 0.1, "k4": 0.4, "fl_x": 9.0, "w": 8, "h": 6, "frames": [frame()]}
    save_image(tmp_path / "train/r_0.png")
    [lens] = read_transforms(write_json(tmp_path / "transforms.json", data)).lenses.values()
    assert (lens.model, lens.params[4:]) == ("OPENCV_FISHEYE", (0.1, 0.0, 0.0, 0.4))


@pytest.mark.parametrize(("name", "split"), [("a_test", "test"), ("transforms_val", "test"), ("transforms_train", "train"), ("a", "train")])
def test_the_name_of_a_lone_file_says_its_split(tmp_path, name, split):
    path = write_json(tmp_path / f"{name}.json", {"fl_x": 9.0, "w": 8, "h": 6, "frames": [frame()]})
    assert [camera.split for camera in read_transforms(path).cameras] == [split]


def test_distortion_may_be_a_list(tmp_path):
    """Its numbers were passed over without a word."""
    data = {"distortion_params": [0.1, 0, 0, 0, 0, 0], "k1": 0.3, "fl_x": 9.0, "frames": [frame()]}
    save_image(tmp_path / "train/r_0.png")
    [lens] = read_transforms(write_json(tmp_path / "transforms.json", data)).lenses.values()
    assert lens.params[4:] == (0.1, 0, 0, 0)


def test_what_is_null_is_not_stated(tmp_path):
    frames = [frame() | {"fl_y": None, "cx": None, "w": None, "h": None, "k1": None, "time": None}]
    data = {"fl_x": 9.0, "fl_y": None, "cy": None, "w": 8, "h": 6, "frames": frames}
    [camera] = read_transforms(write_json(tmp_path / "transforms.json", data)).cameras
    assert (camera.fy, camera.cx, camera.cy, camera.size, camera.time) == (9.0, 4.0, 3.0, (6, 8), None)


def test_test_frames_of_scannetpp_are_test_views(tmp_path):
    """They were left out."""
    data = {"fl_x": 9.0, "w": 8, "h": 6, "frames": [frame(), frame(file_path="b")], "test_frames": [frame(file_path="c")]}
    cameras = read_transforms(write_json(tmp_path / "transforms.json", data)).cameras
    assert [(camera.name, camera.split) for camera in cameras] == [("r_0", "train"), ("b", "train"), ("c", "test")]


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
        ({"cx": 0.5}, r"frame 0 \(r_0\): has cx 0.5, but must have pixels"),
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


@pytest.mark.parametrize("model", ["OPENCV", "PERSPECTIVE", "pinhole", None])
def test_zero_distortion_is_no_distortion(tmp_path, model):
    data = {"fl_x": 9.0, "w": 8, "h": 8, "k1": 0.0, "camera_model": model, "frames": [frame()]}
    assert len(read_transforms(write_json(tmp_path / "transforms.json", data)).cameras) == 1


@pytest.mark.parametrize(("content", "lacks"), [([], "no list"), ({"frames": []}, "lists no frames"), ({"frames": 3}, "no list"), ({}, "no list")])
def test_a_file_without_frames_is_named(tmp_path, content, lacks):
    with pytest.raises(SceneError, match=lacks):
        read_transforms(write_json(tmp_path / "transforms.json", content))


def test_a_photograph_that_was_cropped_a_little_is_told_of(tmp_path):
    save_image(tmp_path / "train/r_0.png", 40, 28)
    scene = read_transforms(write_json(tmp_path / "transforms.json", {"camera_angle_x": 0.8, "w": 40, "h": 30, "frames": [frame()]}))
    [note] = scene.warnings()
    assert "stretched to the shape of 1 photograph, as in 3DGS (r_0.png has 40 x 28 px, its camera 40 x 30 px); if photographs were cropped" in note


def test_numbers_of_a_lens_may_be_texts(tmp_path):
    """As `ns-process-data realitycapture` wrote them until May 2024, of images without distortion too."""
    zero = dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), "0.0")
    path = write_json(tmp_path / "transforms.json", {"w": 80, "h": 60, "frames": [frame(fl_x=70.0, fl_y=70.0, **zero)]})
    scene = read_transforms(path)
    assert (scene.lenses, scene.cameras[0].fx) == ({}, 70.0)
    bent = write_json(tmp_path / "bent.json", {"w": 80, "h": 60, "frames": [frame(fl_x=70.0, **{**zero, "k1": "wide"})]})
    with pytest.raises(SceneError, match="k1: is not made of numbers"):
        read_transforms(bent)
