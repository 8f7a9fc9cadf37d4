"""Scenes that SHARP makes of one photograph: their PLY has the camera in it."""

import json

import numpy as np
import pytest
import tiny
import torch
from plyfile import PlyData, PlyElement

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.views.for_validation import split_validation
from mipmap_plugin.adaptation.views.policy import choose_views
from mipmap_plugin.adaptation.views.viewpoints import Viewpoints
from mipmap_plugin.errors import SceneError
from mipmap_plugin.evaluation.tradeoff.truth import base_itself, unseen
from mipmap_plugin.levels.yardstick import Yardstick
from mipmap_plugin.recipes import recipe
from mipmap_plugin.scenes import cameras_in, load_scene
from mipmap_plugin.scenes.orbits import Orbit
from mipmap_plugin.scenes.trajectories import SWAY, with_company

INTRINSIC = (40.0, 0.0, 16.0, 0.0, 40.0, 12.0, 0.0, 0.0, 1.0)
EXTRINSIC = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]])  # the splats lie around the origin


def sharp(path, intrinsic=INTRINSIC, size=(32, 24), *, text=False, without=()):
    """A PLY as SHARP writes it, of the tiny splats. `without`: elements that are left out."""
    sizes = np.float32(size) if isinstance(size[0], float) else np.uint32(size)
    more = {"extrinsic": np.float32(EXTRINSIC.flatten()), "intrinsic": np.float32(intrinsic), "image_size": sizes}
    elements = [PlyElement.describe(values.view([(name, values.dtype)]), name) for name, values in more.items() if name not in without]
    PlyData([PlyData.read(tiny.ply(path.with_suffix(".plain.ply")))["vertex"], *elements], text=text).write(path)
    return path


@pytest.mark.parametrize("text", [False, True])
def test_the_camera_is_that_of_the_photograph(tmp_path, text):
    [camera] = wrap_model(sharp(tmp_path / "photo.ply", text=text)).cameras
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (32, 24, 40, 40, 16, 12)
    assert torch.equal(camera.viewmat, EXTRINSIC.double())
    assert [each.fx for each in load_scene(tmp_path / "photo.ply").cameras] == [40.0]


def test_without_a_pose_the_camera_is_at_the_origin(tmp_path):
    """As for SHARP's own loader: what its ports to browsers write has none."""
    [camera] = cameras_in(sharp(tmp_path / "photo.ply", without=("extrinsic",)))
    assert torch.equal(camera.viewmat, torch.eye(4, dtype=torch.float64)) and camera.fx == 40.0
    assert cameras_in(sharp(tmp_path / "sizeless.ply", without=("image_size",))) == []


@pytest.mark.parametrize("scale", [1 / 2, 2])
def test_views_to_its_sides_are_adapted_to_and_validated_by(scale):
    lone, orbit, config = tiny.cameras(1), Orbit((0.0, 0.0, 0.0), None, 1.0), recipe("default", scale, views="jittered", extra_views=4)
    viewpoints = Viewpoints(orbit, list)
    views, _ = choose_views(lone, viewpoints, config)
    adapted, validation = split_validation(lone, views, viewpoints, scale, config)
    for seen in adapted[1:], validation:
        assert max((view.center - lone[0].center).norm() for view in seen) > SWAY / 4


def test_levels_and_tradeoffs_are_measured_to_its_sides_too():
    lone = tiny.cameras(1)
    base = wrap_model(tiny.model(20), cameras=lone, backend="reference")
    for judged in Yardstick(base, 0).views, base_itself(base, 1 / 2, None).views, unseen(base, lone):
        assert max((view.center - lone[0].center).norm() for view in judged) > SWAY / 4


def test_the_adapted_file_is_seen_from_there_too(tmp_path):
    adapted = wrap_model(sharp(tmp_path / "photo.ply")).adapt(1 / 2, steps=1, extra_views=3)
    saved = adapted.save(tmp_path / "half.ply")
    assert "1 train view and 3 around it" in json.loads((tmp_path / "half.ply.adaptation.json").read_text())["views"]
    [camera] = wrap_model(saved).cameras
    assert camera.fx == 40.0


def test_a_camera_that_is_none_is_refused_and_other_elements_are_none(tmp_path):
    with pytest.raises(SceneError, match=r"photo.ply: the camera in it is none: .* focal lengths must be positive .*; give others \(--cameras\)"):
        wrap_model(sharp(tmp_path / "photo.ply", (0.0, *INTRINSIC[1:])))
    with pytest.raises(SceneError, match=r"the camera in it is none: .* width must be a whole number, got nan"):
        wrap_model(sharp(tmp_path / "size.ply", size=(np.nan, 24.0)))
    others = sharp(tmp_path / "other.ply", (40.0, 40.0)), tmp_path / "other.plain.ply", tmp_path / "none.ply"
    assert [cameras_in(other) for other in others] == [[], [], []]


@pytest.mark.parametrize(
    ("declared", "hostile"),
    [(b"intrinsic 9\n", b"intrinsic 900000000000000000\n"), (b"property float intrinsic", b"property list uchar float intrinsic")],
)
def test_elements_that_are_no_camera_are_no_camera(tmp_path, declared, hostile):
    file = sharp(tmp_path / "photo.ply")
    file.write_bytes(file.read_bytes().replace(declared, hostile))
    assert cameras_in(file) == []


def test_a_camera_that_is_cut_off_is_told_of(tmp_path):
    file = sharp(tmp_path / "photo.ply")
    whole = file.read_bytes()
    file.write_bytes(whole[:-1])
    with pytest.raises(SceneError, match="is truncated: it ends before its element 'image_size' does"):
        wrap_model(file)
    file.write_bytes(whole.replace(b"element intrinsic", b"element other 900000000000000000\nproperty float other\nelement intrinsic"))
    with pytest.raises(SceneError, match="is truncated"):
        cameras_in(file)


def test_views_around_a_lone_camera_move_sideways():
    lone, orbit = tiny.cameras(1), Orbit((0.0, 0.0, 0.0), None, 1.0)
    distance = lone[0].center.norm()
    moved = torch.stack([each.center - lone[0].center for each in with_company(lone, orbit)[1:]])
    torch.testing.assert_close(moved.norm(dim=1), (SWAY * distance).expand(4))
    assert (moved @ lone[0].viewmat[2, :3]).abs().max() < 1e-9 and moved.sum(0).abs().max() < 1e-9
    assert with_company(tiny.cameras(2), orbit)[0].name == tiny.cameras(2)[0].name and len(with_company(tiny.cameras(2), orbit)) == 2
