"""Scenes of fVDB Reality Capture: their PLY has the cameras in it, and the settings of the training."""

import numpy as np
import pytest
import tiny
from plyfile import PlyData, PlyElement

from mipmap_plugin import wrap_model
from mipmap_plugin.errors import SceneError
from mipmap_plugin.formats.fvdb import MAGIC, filter_of
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.tags import recorded_filter
from mipmap_plugin.scenes import cameras_in, load_scene

SETTINGS = (f"{MAGIC}eps2d|double|0.25", f"{MAGIC}antialias|int64|1", f"{MAGIC}near_plane|double|0.01", f"{MAGIC}note|str|a|b")


def fvdb(path, **others):
    """A PLY as fVDB writes it, of the tiny splats and four cameras. `others`: tensors in place of these, or beside them; None for none."""
    views = tiny.cameras(4)
    tensors = {
        "normalization_transform": np.eye(4, dtype=np.float32),
        "camera_to_world_matrices": np.stack([np.linalg.inv(view.viewmat.numpy()) for view in views]).astype(np.float32),
        "projection_matrices": np.float32([[[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]] for view in views]),
        "image_sizes": np.int32([[view.height, view.width] for view in views]),
    }
    tensors = {key: tensor for key, tensor in {**tensors, **others}.items() if tensor is not None}
    elements = [PlyElement.describe(tensor.reshape(-1).view([("value", tensor.dtype)]), key) for key, tensor in tensors.items()]
    shapes = [f"{MAGIC}{key}|tensor|{','.join(map(str, (tensor.ndim, *tensor.shape)))}" for key, tensor in tensors.items()]
    vertex = PlyData.read(tiny.ply(path.with_suffix(".plain.ply")))["vertex"]
    PlyData([vertex, *elements], comments=["fvdb_gs_ply_version fvdb_ply 1.0.0", *shapes, *SETTINGS]).write(path)
    return path


def test_the_cameras_are_those_of_the_training(tmp_path):
    views, read = tiny.cameras(4), wrap_model(fvdb(tmp_path / "a.ply")).cameras
    assert [(each.width, each.height, each.cx, each.cy) for each in read] == [(each.width, each.height, each.cx, each.cy) for each in views]
    assert [each.fx for each in read] == pytest.approx([each.fx for each in views])
    assert max(float((a.viewmat - b.viewmat).abs().max()) for a, b in zip(read, views, strict=True)) < 1e-5
    assert len(load_scene(tmp_path / "a.ply").cameras) == 4


def test_orthographic_cameras_are_left_out(tmp_path):
    read = cameras_in(fvdb(tmp_path / "a.ply", camera_models=np.int32([0, 5, 2, 5])))
    assert [camera.name for camera in read] == ["camera_0000", "camera_0002"]


def test_elements_without_poses_are_no_cameras(tmp_path):
    assert cameras_in(fvdb(tmp_path / "none.ply", camera_to_world_matrices=None)) == []
    assert cameras_in(fvdb(tmp_path / "fewer.ply", image_sizes=np.int32([[24, 32]]))) == []


def test_a_pose_that_is_none_is_told_of(tmp_path):
    with pytest.raises(SceneError, match=r"a.ply: the camera in it is none: c2w: the pose .* cannot be inverted; give others"):
        cameras_in(fvdb(tmp_path / "a.ply", camera_to_world_matrices=np.zeros((4, 4, 4), np.float32)))


def test_the_filter_is_that_of_the_settings(tmp_path):
    model = wrap_model(fvdb(tmp_path / "a.ply")).model
    assert (model.trained.screen_filter, model.trained.eps2d) == ("antialiased", 0.25)
    assert "the header says that the splats are to be drawn antialiased (0.25 px²)" in model.notes


@pytest.mark.parametrize("settings", [(), SETTINGS[:1], (SETTINGS[0], f"{MAGIC}antialias|int64|yes"), (f"{MAGIC}eps2d|double|nan", SETTINGS[1])])
def test_settings_that_do_not_tell_both_tell_no_filter(settings):
    assert filter_of(settings) is None


def test_a_later_tag_counts_for_more():
    assert recorded_filter([*SETTINGS, "SplatRenderMode: default"]) is None


def test_adapted_files_name_no_tensors_that_they_lack(tmp_path):
    """fVDB's loader asks for the element of each tensor that a comment names, and fails without it."""
    wrapped = wrap_model(fvdb(tmp_path / "a.ply"))
    assert "which are left out of files that are made of it" in wrapped.model.notes[0]
    file = read_ply(wrapped.adapt(1 / 2, recipe="instant", viewer="classic").save(tmp_path / "half.ply"))
    told = [comment for comment in file.comments if comment.startswith(MAGIC)]
    assert told == [f"{MAGIC}eps2d|double|0.29999999999999999", f"{MAGIC}antialias|int64|0", *SETTINGS[2:]]
    assert "fvdb_gs_ply_version fvdb_ply 1.0.0" in file.comments
