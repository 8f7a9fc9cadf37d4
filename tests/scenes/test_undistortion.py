"""Lens distortion: in the undistorted photograph a point of the world is where the pinhole camera projects it."""

import json
import sys

import pytest
import tiny
import torch
from colmap_files import names, write_text_model
from torch_checkpoints import gsplat_folder, splats

from mipmap_plugin.adaptation.views.placing import placed
from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SceneError, SettingsError
from mipmap_plugin.evaluation import protocols
from mipmap_plugin.evaluation.judged import judged_views
from mipmap_plugin.formats.images import write_image
from mipmap_plugin.models import load_model
from mipmap_plugin.scenes import load_scene
from mipmap_plugin.wrap import wrap_model

pycolmap = pytest.importorskip("pycolmap")

WIDTH, HEIGHT = 200, 150
LENSES = {
    "SIMPLE_RADIAL": [160, 100, 75, -0.15],
    "OPENCV": [160, 158, 103, 72, -0.12, 0.03, 0.004, -0.006],
    "FULL_OPENCV": [160, 158, 103, 72, -0.12, 0.03, 0.004, -0.006, 0.02, 0, 0, 0],
    "OPENCV_FISHEYE": [120, 121, 103, 72, 0.05, -0.01, 0.002, 0.001],
}
POINTS = torch.tensor([[-0.25, -0.18, 1.0], [0.22, 0.2, 1.0], [0.3, -0.15, 1.0], [0.0, 0.0, 1.0]], dtype=torch.float64)  # in camera axes


def photograph(model, params, size=(WIDTH, HEIGHT)):
    """A soft dot for each point, where the lens projects it."""
    lens = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params)
    lens.rescale(*size)
    ys, xs = torch.meshgrid(torch.arange(size[1]) + 0.5, torch.arange(size[0]) + 0.5, indexing="ij")
    image = torch.zeros(size[1], size[0])
    for x, y in torch.as_tensor(lens.img_from_cam(POINTS.numpy())).tolist():
        image += torch.exp(-((xs - x) ** 2 + (ys - y) ** 2) / (2 * 2.0**2))
    return image[..., None].expand(-1, -1, 3)


def colmap_scene(path, model, size=(WIDTH, HEIGHT)):
    write_text_model(path / "sparse/0", names(1), model, " ".join(map(str, LENSES[model])), size=(WIDTH, HEIGHT))
    (path / "images").mkdir()
    write_image(path / "images" / names(1)[0], photograph(model, LENSES[model], size))
    return load_scene(path)


def nerfstudio_scene(path, model):
    """As ns-process-data writes it."""
    keys = ["fl_x", "fl_y", "cx", "cy", "k1", "k2", *(["k3", "k4"] if model == "OPENCV_FISHEYE" else ["p1", "p2", "k3"])]
    written = "OPENCV_FISHEYE" if "FISHEYE" in model else "OPENCV"
    lens = dict(zip(keys, LENSES[model], strict=False)) | {"w": WIDTH, "h": HEIGHT, "camera_model": written}
    pose = torch.diag(torch.tensor([1.0, -1, -1, 1])).tolist()
    path.mkdir(exist_ok=True)
    (path / "transforms.json").write_text(json.dumps({**lens, "frames": [{"file_path": "images/a.png", "transform_matrix": pose}]}))
    write_image(path / "images/a.png", photograph(model, LENSES[model]))
    return load_scene(path)


def assert_dots_at(camera: Camera, image: torch.Tensor) -> None:
    assert tuple(image.shape[:2]) == camera.size
    for x, y, z in POINTS.tolist():
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        near = image[int(v) - 7 : int(v) + 8, int(u) - 7 : int(u) + 8, 0]
        ys, xs = torch.meshgrid(torch.arange(int(v) - 7, int(v) + 8) + 0.5, torch.arange(int(u) - 7, int(u) + 8) + 0.5, indexing="ij")
        center = [float((near * place).sum() / near.sum()) for place in (xs, ys)]
        assert center == pytest.approx([u, v], abs=0.35)
        assert near.max() > 0.85  # 0.94 between pixels; pycolmap before 4.2 blurs a little more


@pytest.mark.parametrize("model", LENSES)
def test_points_of_a_colmap_scene_are_where_its_pinhole_projects_them(tmp_path, model):
    scene = colmap_scene(tmp_path, model)
    assert_dots_at(scene.cameras[0], scene.image(scene.cameras[0], (0, 0, 0)))


def test_photographs_that_were_shrunk_since_are_undistorted_at_their_size(tmp_path):
    scene = colmap_scene(tmp_path, "OPENCV", (2 * WIDTH, 2 * HEIGHT))
    assert_dots_at(scene.cameras[0], scene.image(scene.cameras[0], (0, 0, 0)))
    assert scene.cameras[0].fx == 320


@pytest.mark.parametrize("model", ["OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"])
def test_points_of_a_nerfstudio_scene_are_where_its_pinhole_projects_them(tmp_path, model):
    scene = nerfstudio_scene(tmp_path / "s", model)
    assert_dots_at(scene.cameras[0], scene.image(scene.cameras[0], (0, 0, 0)))
    assert any("bend" in note for note in scene.notes)


def test_without_undistortion_points_are_elsewhere(tmp_path):
    """In the distorted photograph, some dot is not where the pinhole projects it."""
    scene = colmap_scene(tmp_path, "OPENCV")
    pinhole = Camera(WIDTH, HEIGHT, 160, 158, 103, 72, torch.eye(4))
    with pytest.raises(AssertionError):
        assert_dots_at(pinhole, photograph("OPENCV", LENSES["OPENCV"]))
    assert scene.cameras[0].size != pinhole.size


def test_a_distorted_scene_has_cameras_to_adapt_with_and_images_to_evaluate_on(tmp_path):
    scene = nerfstudio_scene(tmp_path / "s", "OPENCV")
    wrapped = wrap_model(tiny.model(), cameras=scene)
    assert wrapped.adapt(1 / 4, steps=1, views="given").report.views == "the 1 given view"
    [view] = judged_views(scene, scene.cameras, (0.0, 0.0, 0.0))
    assert_dots_at(view.camera, view.truth(1.0, protocols.PROTOCOLS["P3"]))
    with pytest.raises(SettingsError, match=r"P4.*lens distortion"):
        view.truth(1.0, protocols.PROTOCOLS["P4"])


def test_without_pycolmap_the_poses_are_usable_and_the_photographs_are_not(tmp_path, monkeypatch):
    nerfstudio_scene(tmp_path / "s", "OPENCV")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    scene = load_scene(tmp_path / "s")
    assert (scene.cameras[0].fx, scene.cameras[0].size) == (160, (HEIGHT, WIDTH))
    assert any("pip install" in note for note in scene.notes)
    with pytest.raises(SceneError, match="pip install"):
        scene.image(scene.cameras[0], (0, 0, 0))


def test_projects_that_downscale_a_distorted_scene_downscale_its_undistorted_size(tmp_path):
    """gsplat's factor applies to the undistorted camera; the smaller copies on disk are distorted."""
    scene = colmap_scene(tmp_path, "OPENCV")
    write_image(tmp_path / "images_2" / names(1)[0], photograph("OPENCV", LENSES["OPENCV"], (WIDTH // 2, HEIGHT // 2)))
    model = load_model(gsplat_folder(tmp_path / "r", splats(), normalized="false"))
    model._origin.host.options["data_factor"] = 2
    [camera], [whole] = placed(model, scene).cameras, scene.cameras
    assert camera.fx == pytest.approx(whole.fx / 2, rel=0.01)
    assert camera.width == pytest.approx(whole.width / 2, abs=1)
