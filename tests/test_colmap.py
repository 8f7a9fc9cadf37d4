"""COLMAP scenes: the mip-NeRF 360 protocol, absent photographs, distortion, and a real phone capture."""

import json
import math
import sys
import warnings

import numpy as np
import pytest
import torch
from PIL import Image

from mipmap_plugin.adaptation.target.photographs import Photographs
from mipmap_plugin.errors import SceneError, SettingsError
from mipmap_plugin.evaluation.protocols import PROTOCOLS
from mipmap_plugin.evaluation.protocols import test_views as judged_views
from mipmap_plugin.scenes import load_photographs, load_scene

pycolmap = pytest.importorskip("pycolmap", reason="COLMAP scenes are read by pycolmap, an extra")

# FORMATS §13, T2: the quaternion (w, x, y, z) and shift of a world-to-camera pose, and its matrix.
QUATERNION, SHIFT = (0.9, 0.1, -0.2, 0.3), (0.5, -0.25, 4.0)
ROTATION = [[0.726315789, -0.610526316, -0.315789474], [0.526315789, 0.789473684, -0.315789474], [0.442105263, 0.063157895, 0.894736842]]


def write_text_model(folder, names, model="PINHOLE", params="70 72 31 25", points=3):
    """A model in COLMAP's text format, every image at the pose of T2, 64 x 48 px."""
    folder.mkdir(parents=True)
    length = math.sqrt(sum(q * q for q in QUATERNION))
    pose = " ".join(str(q / length) for q in QUATERNION) + " " + " ".join(map(str, SHIFT))
    (folder / "cameras.txt").write_text(f"1 {model} 64 48 {params}\n")
    (folder / "images.txt").write_text("".join(f"{i + 1} {pose} 1 {name}\n\n" for i, name in enumerate(names)))
    (folder / "points3D.txt").write_text("".join(f"{i + 1} {i} 2 3 255 0 0 0.5\n" for i in range(points)))


def write_photographs(folder, names, size=(64, 48)):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.zeros((size[1], size[0], 3), np.uint8)).save(folder / name)


def names(count):
    """File names in an order that is not the alphabet's."""
    return [f"{(7 * i) % count:03d}.png" for i in range(count)]


def test_a_camera_is_where_colmap_says(tmp_path):
    write_text_model(tmp_path / "sparse/0", ["a/left.png"])
    scene = load_scene(tmp_path)
    [camera] = scene.cameras
    assert np.allclose(camera.viewmat[:3, :3].numpy(), ROTATION, atol=1e-8)
    assert np.allclose(camera.viewmat[:3, 3].numpy(), SHIFT)
    assert np.allclose(camera.center.numpy(), [-2, 0.25, -3.5])
    assert (camera.name, camera.width, camera.height) == ("a/left", 64, 48)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (70, 72, 31, 25)
    assert torch.equal(scene.points, torch.tensor([[0.0, 2, 3], [1, 2, 3], [2, 2, 3]], dtype=torch.float64))


def test_a_model_by_another_number_is_read_where_there_is_no_0(tmp_path):
    """People delete the small sparse/0 that COLMAP's mapper made first."""
    write_text_model(tmp_path / "sparse/1", names(2))
    write_photographs(tmp_path / "images", names(2))
    for given in (tmp_path, tmp_path / "sparse", tmp_path / "sparse/1"):
        assert len(load_scene(given).images) == 2


def test_a_larger_model_than_that_which_is_read_is_named(tmp_path):
    """COLMAP numbers its models as it begins them; 3DGS, gsplat and nerfstudio take sparse/0, Brush the largest."""
    for number, images in enumerate((3, 2, 5)):
        write_text_model(tmp_path / f"sparse/{number}", names(images))
    pycolmap.Reconstruction(tmp_path / "sparse/2").write_binary(tmp_path / "sparse/2")
    with pytest.warns(UserWarning, match=r"sparse/0 is read, which has 3 images, but .*sparse/2 has 5: .* give that folder"):
        assert len(load_scene(tmp_path).cameras) == 3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(load_scene(tmp_path / "sparse/2").cameras) == 5


@pytest.mark.parametrize(("folder", "prefix"), [("images", "images/"), (".", "")])
def test_photographs_are_found_from_the_folder_above_images(tmp_path, folder, prefix):
    """COLMAP may have been run on that, or a program may write the model beside the photographs."""
    write_text_model(tmp_path / "desk", [f"{prefix}{name}" for name in names(2)])
    write_photographs(tmp_path / "desk" / folder, names(2))
    assert len(load_scene(tmp_path / "desk").images) == 2


def test_names_of_images_may_have_blanks(tmp_path):
    """In COLMAP's text too, where they are the rest of the line; below each image are its points, of which there may be none."""
    photographs = ["my photo  1.png", "left/my photo 2.png", "3.png"]
    write_text_model(tmp_path / "sparse/0", photographs)
    text = (tmp_path / "sparse/0/images.txt").read_text()
    (tmp_path / "sparse/0/images.txt").write_text("# Image list\n" + text.replace("1.png\n\n", "1.png\n1 2 -1 3 4 -1\n") + "\n")
    write_photographs(tmp_path / "images", photographs)
    scene = load_scene(tmp_path)
    assert {camera.name: file.name for camera, file in scene.images.items()} == {
        "3": "3.png", "left/my photo 2": "my photo 2.png", "my photo  1": "my photo  1.png",
    }  # fmt: skip


def test_a_text_model_without_lines_of_points_is_refused(tmp_path):
    """pycolmap reads every other of its images."""
    write_text_model(tmp_path / "sparse/0", names(4))
    images = tmp_path / "sparse/0/images.txt"
    images.write_text(images.read_text().replace("\n\n", "\n"))
    with pytest.raises(SceneError, match=r"images.txt, image 1: has no line of points below it; add one, which may be empty, below every image"):
        load_scene(tmp_path)


def test_a_model_that_lacks_a_file_names_it(tmp_path):
    write_text_model(tmp_path / "sparse/0", names(2))
    (tmp_path / "sparse/0/points3D.txt").unlink()
    with pytest.raises(SceneError, match=r"sparse/0: lacks points3D.txt, without which pycolmap reads no model; copy the whole folder"):
        load_scene(tmp_path)


def test_every_eighth_of_the_sorted_names_is_a_test_view(tmp_path):
    write_text_model(tmp_path / "sparse/0", names(20))
    scene = load_scene(tmp_path)
    assert [camera.name for camera in scene.cameras] == [f"{i:03d}" for i in range(20)]
    assert [camera.name for camera in scene.split("test")] == ["000", "008", "016"]


def test_photographs_of_another_folder_keep_the_field_of_view(tmp_path):
    write_text_model(tmp_path / "sparse/0", names(2), points=0)
    write_photographs(tmp_path / "images_2", ["000.png"], size=(32, 24))
    scene = load_scene(tmp_path, {"images": "images_2", "eval": True})
    there, absent = scene.cameras
    assert there.size == absent.size == (24, 32)  # the absent one by the name of its folder
    assert (there.fx, there.fy) == (absent.fx, absent.fy) == (35, 36)
    assert list(scene.images) == [there]
    assert scene.points is None and scene.numbers == (1, 2)


@pytest.mark.parametrize("cfg", [None, {"images": "images", "eval": True}])
def test_copies_are_the_photographs_where_there_are_no_others(tmp_path, cfg):
    """mip-NeRF 360 has images_4 and images_8, and large photographs beside them that people delete. Sizes stay those of the training."""
    write_text_model(tmp_path / "sparse/0", names(2), "SIMPLE_RADIAL", "70 32 24 0.1")
    write_photographs(tmp_path / "images_8", names(2), size=(8, 6))
    write_photographs(tmp_path / "images_4", names(1), size=(16, 12))
    scene = load_scene(tmp_path, cfg)
    assert {camera.size for camera in scene.cameras} == {(45, 61)} and {camera.fx for camera in scene.cameras} == {70}
    assert list(scene.images.values()) == [tmp_path / "images_4/000.png"] and scene.smaller(8) == (8, 6)
    assert scene.image(scene.cameras[0], (0, 0, 0)).shape == (10, 14, 3)
    assert any(note == "there is no folder images: the photographs are those of images_4" for note in scene.notes)


def test_a_wide_lens_makes_photographs_larger_when_they_are_undistorted(tmp_path):
    """A training on the undistorted ones is adapted to the whole ones, but not to copies."""
    write_text_model(tmp_path / "sparse/0", names(2), "SIMPLE_RADIAL", "40 32 24 -0.2")
    write_photographs(tmp_path / "images", names(2))
    scene = load_scene(tmp_path)
    [view] = Photographs(scene, scene.cameras, (0, 0, 0)).cameras
    assert (view.width, view.height) == (77, 51)
    (tmp_path / "images").rename(tmp_path / "images_2")
    write_photographs(tmp_path / "images_2", names(2), size=(32, 24))
    with pytest.raises(SettingsError, match="has 37 x 24 px, but the base was trained at 74 x 48 px"):
        Photographs(load_scene(tmp_path), scene.cameras, (0, 0, 0))


def test_an_undistorted_copy_is_judged_in_its_own_field_of_view(tmp_path):
    """Its sides are rounded by itself: what is 77 px wide at full size is 37 px wide at half."""
    write_text_model(tmp_path / "sparse/0", ["a.png"], "SIMPLE_RADIAL", "40 32 24 -0.2")
    write_photographs(tmp_path / "images_2", ["a.png"], size=(32, 24))
    scene = load_scene(tmp_path)
    [camera], [view] = scene.cameras, judged_views(scene, scene.cameras, (0.0, 0.0, 0.0))
    height, width, _ = scene.image(camera, (0, 0, 0)).shape
    assert (view.camera.size, view.camera.fx) == ((2 * height, 2 * width), 40) and camera.size != view.camera.size
    assert view.truth(1 / 2, PROTOCOLS["P3"]).shape == (height, width, 3)


def test_photographs_that_were_turned_are_refused(tmp_path):
    write_text_model(tmp_path / "sparse/0", ["a.png"])
    write_photographs(tmp_path / "images", ["a.png"], size=(48, 64))
    with pytest.raises(SceneError, match=r"a.png: its camera is of 64 x 48 px, but the photograph has 48 x 64 px: it was turned or cropped"):
        load_scene(tmp_path)


@pytest.mark.parametrize(("orientation", "advice"), [(6, "its EXIF says to show it turned, .* turned "), (3, "it was turned or cropped")])
def test_photographs_that_exif_would_turn_are_refused_with_what_to_do(tmp_path, orientation, advice):
    write_text_model(tmp_path / "sparse/0", ["a.png"])
    (tmp_path / "images").mkdir()
    exif = Image.Exif()
    exif[0x112] = orientation
    Image.new("RGB", (48, 64)).save(tmp_path / "images/a.png", exif=exif)
    with pytest.raises(SceneError, match=f"the photograph has 48 x 64 px: {advice}"):
        load_scene(tmp_path)


@pytest.mark.parametrize(("resolution", "size"), [(1, (48, 64)), (2, (24, 32)), (8, (6, 8)), (-1, (48, 64)), (20, (15, 20))])
def test_the_training_size_follows_r_with_photographs_and_without(tmp_path, resolution, size):
    write_text_model(tmp_path / "sparse/0", names(2))
    write_photographs(tmp_path / "images", ["000.png"])
    scene = load_scene(tmp_path, {"resolution": resolution, "eval": True})
    assert [camera.size for camera in scene.cameras] == [size, size]
    assert scene.image(scene.cameras[0], (0, 0, 0)).shape == (48, 64, 3)


def test_a_checkpoint_with_cfg_args_has_its_principal_point_in_the_middle(tmp_path):
    write_text_model(tmp_path / "sparse/0", names(1))
    camera = load_scene(tmp_path, {"resolution": 2, "eval": True}).cameras[0]
    assert (camera.cx, camera.cy) == (16, 12)
    write_text_model(tmp_path / "bent/sparse/0", names(1), "SIMPLE_RADIAL", "70 20 24 0.1")  # it was trained on the undistorted one
    camera = load_scene(tmp_path / "bent", {"eval": True}).cameras[0]
    assert (camera.cx, camera.cy) == (camera.width / 2, camera.height / 2)


@pytest.mark.parametrize(
    ("option", "model", "params", "size"),
    [("n_offsets", "SIMPLE_RADIAL", "70 32 24 0.1", (48, 64)), ("kplanes_config", "OPENCV", "70 70 32 24 0.1 0 0 0", (48, 64)),
     ("n_offsets", "OPENCV", "70 70 32 24 0.1 0 0 0", (45, 61)), ("kernel_size", "SIMPLE_RADIAL", "70 32 24 0.1", (45, 61))],
)  # fmt: skip
def test_some_projects_train_on_photographs_as_they_are(tmp_path, option, model, params, size):
    """scene/dataset_readers.py of Scaffold-GS, Octree-GS and 4DGaussians; elsewhere only photographs that were undistorted before are trained on."""
    write_text_model(tmp_path / "sparse/0", names(2), model, params)
    write_photographs(tmp_path / "images", names(1))
    as_it_is = size == (48, 64)
    for scene in (load_scene(tmp_path, {option: 10, "resolution": 1}), load_photographs(tmp_path, {option: 10, "resolution": 8})):
        assert {camera.size for camera in scene.cameras} == {size}
        assert bool(scene.lenses) != as_it_is and any("for pinholes" in note for note in scene.notes) == as_it_is


@pytest.mark.parametrize(
    ("cfg", "numbers"),
    [({"eval": True}, [None, *range(7), None, 7]), ({"eval": False}, list(range(10))), ({"eval": True, "lod": 3}, [*[None] * 4, *range(6)]),
     ({"eval": True, "appearance_dim": 0}, [None] * 10)],
)  # fmt: skip
def test_training_views_are_numbered_for_models_with_appearances(tmp_path, cfg, numbers):
    """By their names, as in Scaffold-GS and Octree-GS: each has an appearance of its own, without which it is shown with the mean of all."""
    write_text_model(tmp_path / "sparse/0", [f"{number}.png" for number in range(10)])
    assert [camera.index for camera in load_scene(tmp_path, {"appearance_dim": 32, **cfg}).cameras] == numbers
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in "ab"]
    for split in ("train", "test"):
        (tmp_path / f"blender/transforms_{split}.json").parent.mkdir(exist_ok=True)
        (tmp_path / f"blender/transforms_{split}.json").write_text(json.dumps({"w": 8, "h": 8, "fl_x": 9, "frames": frames}))
    blender = load_scene(tmp_path / "blender", {"appearance_dim": 32, **cfg})
    trained = [None, None] if cfg.get("appearance_dim") == 0 else [0, 1]
    assert [camera.index for camera in blender.cameras] == ([*trained, None, None] if cfg["eval"] else [0, 1, 2, 3])


@pytest.mark.parametrize(("lod", "tests"), [(3, [0, 1, 2, 3]), (54, [55, 56, 57, 58, 59])])
def test_the_option_lod_of_scaffold_holds_out_the_first_or_the_last_views(tmp_path, lod, tests):
    """scene/dataset_readers.py: up to 49 those with numbers up to it, from 50 on those with larger ones."""
    write_text_model(tmp_path / "sparse/0", [f"{number:03}.png" for number in range(60)])
    scene = load_scene(tmp_path, {"eval": True, "lod": lod})
    assert [number for number, camera in enumerate(scene.cameras) if camera.split == "test"] == tests
    assert f"what lod={lod} holds out is for testing" in scene.notes[0]


def test_notes_say_what_was_assumed(tmp_path):
    write_text_model(tmp_path / "sparse/0", names(9))
    write_photographs(tmp_path / "images", ["000.png", "003.png"])
    notes = " ".join(load_scene(tmp_path).notes)
    assert "every 8th is for testing" in notes and "7 of 9 photographs" in notes


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_the_model_is_found_where_programs_leave_it(tmp_path, place):
    write_text_model(tmp_path / "s" / place, names(1)) if place != "." else write_text_model(tmp_path / "s", names(1))
    assert len(load_scene(tmp_path / "s").cameras) == 1


@pytest.mark.parametrize("place", ["sparse/0", "colmap/sparse/0", "model"])
def test_every_folder_from_the_models_upwards_finds_the_photographs(tmp_path, place):
    write_text_model(tmp_path / place, names(1))
    write_photographs(tmp_path / "images", names(1))
    folders = [tmp_path / place, *(tmp_path / place).relative_to(tmp_path).parents][:-1]
    assert [len(load_scene(tmp_path / folder).images) for folder in folders] == [1] * len(folders)


def test_photographs_that_are_nowhere_are_missed_beside_the_model(tmp_path):
    write_text_model(tmp_path / "scene/sparse/0", names(1))
    write_photographs(tmp_path / "images", names(1))  # of another scene
    for folder in ("scene", "scene/sparse", "scene/sparse/0"):
        assert f"absent from {tmp_path / 'scene/images'}," in " ".join(load_scene(tmp_path / folder).notes)


BENT = {"SIMPLE_RADIAL": "70 32 24 0.1", "OPENCV": "70 72 32 24 0 0 0.01 0", "OPENCV_FISHEYE": "70 72 32 24 0 0 0 0"}


@pytest.mark.parametrize(("model", "params"), BENT.items())
def test_a_lens_that_bends_becomes_a_pinhole_with_a_note(tmp_path, model, params):
    write_text_model(tmp_path / "sparse/0", names(1), model, params)
    scene = load_scene(tmp_path)
    assert (scene.cameras[0].fx, scene.cameras[0].cx) == (70, scene.cameras[0].width / 2)
    assert any(model in note and "undistorted" in note for note in scene.notes)


@pytest.mark.parametrize(("count", "told"), [(1, "1 camera has a lens that bends (SIMPLE_RADIAL): it "), (2, "2 cameras have lenses that bend (")])
def test_a_note_says_how_many_lenses_bend(tmp_path, count, told):
    write_text_model(tmp_path / "sparse/0", names(count), "SIMPLE_RADIAL", "70 31 25 0.1")
    assert any(note.startswith(told) for note in load_scene(tmp_path).notes)


def test_a_lens_model_whose_distortion_is_zero_is_a_pinhole(tmp_path):
    write_text_model(tmp_path / "sparse/0", names(1), "SIMPLE_RADIAL", "70 31 25 0")
    camera = load_scene(tmp_path).cameras[0]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (70, 70, 31, 25)


def test_broken_models_are_refused_in_one_sentence(tmp_path):
    (tmp_path / "empty/sparse").mkdir(parents=True)
    with pytest.raises(SceneError, match="holds no COLMAP model"):
        load_scene(tmp_path / "empty")
    write_text_model(tmp_path / "bare/sparse/0", [])
    with pytest.raises(SceneError, match="no image with a pose"):
        load_scene(tmp_path / "bare")
    (tmp_path / "torn/sparse/0").mkdir(parents=True)
    for name in ("cameras", "images", "points3D"):
        (tmp_path / f"torn/sparse/0/{name}.bin").write_bytes(b"\1\2\3")
    with pytest.raises(SceneError, match="is truncated or damaged, for it is shorter than its own counts say"):
        load_scene(tmp_path / "torn")


@pytest.mark.parametrize("posed", [True, False])
def test_rigs_of_several_cameras_are_read(tmp_path, posed):
    """COLMAP has them since version 3.12: the pose of a rig's further cameras is in the file where it is known."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, 3, 2, 5
    model = pycolmap.synthesize_dataset(options)
    if not posed:  # and no image was taken by it
        model.add_camera(pycolmap.Camera(camera_id=999, model="PINHOLE", width=64, height=48, params=[70, 72, 31, 25]))
        model.rigs[1].add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 999), None)
    (tmp_path / "sparse/0").mkdir(parents=True)
    model.write_binary(tmp_path / "sparse/0")
    poses = {image.name.removesuffix(".png"): image.cam_from_world().matrix() for image in model.images.values()}
    cameras = {camera.name: camera.viewmat[:3].numpy() for camera in load_scene(tmp_path).cameras}
    assert len(cameras) == 12 and all(np.allclose(cameras[name], pose) for name, pose in poses.items())
    rigs = tmp_path / "sparse/0/rigs.bin"
    rigs.write_bytes(rigs.read_bytes()[:-1])
    with pytest.raises(SceneError, match=r"rigs\.bin: is truncated or damaged"):
        load_scene(tmp_path)


def test_what_is_no_perspective_camera_or_has_no_name_is_refused_in_one_sentence(tmp_path):
    """COLMAP 4 has panoramas, whose model has no focal length."""
    write_text_model(tmp_path / "round/sparse/0", ["a.png"], "EQUIRECTANGULAR", "64 48")
    with pytest.raises(SceneError, match=r"a\.png: has a lens that is not perspective \(EQUIRECTANGULAR\)"):
        load_scene(tmp_path / "round")
    write_text_model(tmp_path / "text", ["a.png"])
    model = pycolmap.Reconstruction(tmp_path / "text")
    model.images[1].name = ""
    (tmp_path / "nameless/sparse/0").mkdir(parents=True)
    model.write_binary(tmp_path / "nameless/sparse/0")
    with pytest.raises(SceneError, match="image 1 of the COLMAP model has no name"):
        load_scene(tmp_path / "nameless")


def test_quaternions_may_have_any_norm(tmp_path):
    def poses(factor):
        file = tmp_path / str(factor) / "sparse/0/images.txt"
        write_text_model(file.parent, ["a.png"])
        number, *quaternion_and_more = file.read_text().split(" ")
        quaternion = [str(factor * float(each)) for each in quaternion_and_more[:4]]
        file.write_text(" ".join([number, *quaternion, *quaternion_and_more[4:]]))
        return load_scene(tmp_path / str(factor)).cameras[0].viewmat

    torch.testing.assert_close(poses(2.5), poses(1), rtol=0, atol=1e-12)


def test_without_pycolmap_the_extra_is_named(tmp_path, monkeypatch):
    write_text_model(tmp_path / "sparse/0", names(1))
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(SceneError, match=r"pip install 'mipmap-plugin\[colmap\]'"):
        load_scene(tmp_path)


def test_a_real_capture_of_which_most_photographs_are_absent(shared_data):
    scene = load_scene(shared_data / "colmap/llff_small")
    assert (len(scene.cameras), len(scene.images), len(scene.split("test"))) == (184, 31, 23)
    assert "153 of 184 photographs" in " ".join(scene.notes)
    assert {camera.size for camera in scene.cameras} == {(960, 544)}
    first = scene.cameras[0]
    assert first in scene.images and scene.image(first, (0, 0, 0)).shape == (960, 544, 3)
    assert scene.points.shape == (6271, 3)
    seen = scene.points @ first.viewmat[:3, :3].T + first.viewmat[:3, 3]
    across = first.fx * seen[:, 0] / seen[:, 2] + first.cx
    assert ((seen[:, 2] > 0) & (across > 0) & (across < first.width)).float().mean() > 0.5  # a capture that looks at one place


@pytest.mark.parametrize(("folder", "taken"), [("rgb", "rgb"), ("images_4", "images"), ("absent", "images")])
def test_photographs_of_a_folder_of_another_name_are_those_of_the_training(tmp_path, folder, taken):
    """Option -i of 3DGS; copies are for training, and the whole photographs for judging."""
    write_text_model(tmp_path / "sparse/0", ["a.png"])
    for place in {taken, "images"}:
        write_photographs(tmp_path / place, ["a.png"])
    scene = load_photographs(tmp_path, {"images": folder, "resolution": 2, "eval": True})
    assert [(file.parent.name, camera.size) for camera, file in scene.images.items()] == [(taken, (48, 64))]


@pytest.mark.parametrize(
    ("size", "told"),
    [((64, 46), True), ((31, 24), False), ((32, 23), False), ((62, 48), True), ((514, 381), False), ((512, 360), True)],
)
def test_photographs_that_were_cropped_a_little_are_told_of_and_rounded_copies_are_not(tmp_path, size, told):
    write_text_model(tmp_path / "sparse/0", names(2))
    write_photographs(tmp_path / "images", names(2), size=size)
    told_of = f"the cameras of 2 photographs are stretched to their shape, as in 3DGS (000.png has {size[0]} x {size[1]} px, its camera 64 x 48 px)"
    assert [note.partition(";")[0] for note in load_scene(tmp_path).warnings()] == [told_of] * told


def test_photographs_may_have_another_suffix_than_colmap_saw(tmp_path):
    """.JPG and .jpg are the same to Windows, and some are converted."""
    write_text_model(tmp_path / "sparse/0", ["a.JPG", "sub/b.jpg", "c.png"])
    write_photographs(tmp_path / "images", ["a.jpg", "sub/b.png", "c.png"])
    assert [file.name for file in load_scene(tmp_path).images.values()] == ["a.jpg", "c.png", "b.png"]
