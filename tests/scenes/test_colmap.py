"""COLMAP models: cameras, lenses, rigs, and which views are held out."""

import json
import shutil
import sys
import warnings

import numpy as np
import pytest
import torch
from colmap_files import SHIFT, names, write_photographs, write_text_model
from scene_files import ROTATION

from mipmap_plugin.errors import SceneError
from mipmap_plugin.scenes import load_scene

pycolmap = pytest.importorskip("pycolmap", reason="COLMAP scenes are read by pycolmap, an extra")


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
    for number, images in enumerate((3, 3, 5)):
        write_text_model(tmp_path / f"sparse/{number}", names(images))
    pycolmap.Reconstruction(tmp_path / "sparse/2").write_binary(tmp_path / "sparse/2")
    with pytest.warns(UserWarning, match=r"sparse/0 is read, which has 3 images, but .*sparse/2 has 5: .* give that folder"):
        assert len(load_scene(tmp_path).cameras) == 3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(load_scene(tmp_path / "sparse/2").cameras) == 5
        shutil.rmtree(tmp_path / "sparse/2")
        assert len(load_scene(tmp_path).cameras) == 3  # sparse/1 has as many


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


def test_a_checkpoint_with_cfg_args_has_its_principal_point_in_the_middle(tmp_path):
    write_text_model(tmp_path / "sparse/0", names(1))
    camera = load_scene(tmp_path, {"resolution": 2, "eval": True}).cameras[0]
    assert (camera.cx, camera.cy) == (16, 12)
    write_text_model(tmp_path / "bent/sparse/0", names(1), "SIMPLE_RADIAL", "70 20 24 0.1")  # it was trained on the undistorted one
    camera = load_scene(tmp_path / "bent", {"eval": True}).cameras[0]
    assert (camera.cx, camera.cy) == (camera.width / 2, camera.height / 2)


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


@pytest.mark.parametrize(("lod", "tests"), [(3, [0, 1, 2, 3]), (50, list(range(51, 60)))])
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
    write_text_model(tmp_path / "s" / place, names(1))
    assert len(load_scene(tmp_path / "s").cameras) == 1


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
        model.rigs[1].add_sensor(pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=999), None)
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
    """COLMAP has panoramas since version 4.1, whose model has no focal length."""
    write_text_model(tmp_path / "round/sparse/0", ["a.png"], "EQUIRECTANGULAR", "64 48")
    known = hasattr(pycolmap.CameraModelId, "EQUIRECTANGULAR")
    said = r"a\.png: has a lens that is not perspective \(EQUIRECTANGULAR\)" if known else "is not a COLMAP model that pycolmap reads"
    with pytest.raises(SceneError, match=said):
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
    with pytest.raises(SceneError, match=r'pip install "mipmap-plugin\[colmap\]"'):
        load_scene(tmp_path)
