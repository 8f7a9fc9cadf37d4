"""Checkpoints with a frame of their own and the scene that they were trained on: cameras are transformed, and photographs show whether rightly."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from torch_checkpoints import gsplat_folder, normalized_by_numpy, splatfacto_folder, splats

from mipmap_plugin.adaptation.views.placing import placed
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.cli import main
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SceneError
from mipmap_plugin.evaluation.evaluate import all_rows, evaluator_of
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.images import read_image
from mipmap_plugin.models import load_model
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.scenes import load_scene
from mipmap_plugin.wrap import wrap_model

# COLMAP's world to that of a nerfstudio transforms.json, and that to the checkpoint's; the file of the run holds their product.
APPLIED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
ORIENTED = np.array([[0.0, 0, 1, 0.5], [1, 0, 0, -0.2], [0, 1, 0, 0.1], [0, 0, 0, 1]])
SCALE = 0.25


def in_checkpoint_frame(raw):
    """The same splats, without view-dependent color, after ORIENTED and SCALE: a cyclic exchange of axes turns quaternions alike."""
    rotation, shift = torch.tensor(ORIENTED[:3, :3]).float(), torch.tensor(ORIENTED[:3, 3]).float()
    turn = 0.5 * torch.tensor([[1.0, -1, -1, -1], [1, 1, -1, 1], [1, 1, 1, -1], [1, -1, 1, 1]])  # times (1, 1, 1, 1) / 2: x to y, y to z, z to x
    means = SCALE * (raw["means"] @ rotation.T + shift)
    return {**raw, "means": means, "quats": raw["quats"] @ turn.T, "scales": raw["scales"] + np.log(SCALE), "shN": 0 * raw["shN"]}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """(folder of the run, folder of its scene): photographs of the splats in the world of transforms.json, the checkpoint in its own."""
    place = tmp_path_factory.mktemp("run")
    raw = splats(60)
    raw["shN"] *= 0
    folder = splatfacto_folder(place / "run", in_checkpoint_frame(raw))
    product = (ORIENTED @ APPLIED)[:3]
    (folder / "dataparser_transforms.json").write_text(json.dumps({"transform": product.tolist(), "scale": SCALE}))
    scene, model, effects = place / "scene", VanillaModel(raw), Effects(1, background=(0.1490, 0.1647, 0.2157), near_plane=0.04)
    views = tiny.cameras(4, width=64, height=48)
    tiny.write_photographs(scene, "train", views, lambda view: ReferenceBackend().render(model.gaussians(), view, effects).image)
    file = scene / "transforms_train.json"
    listed = json.loads(file.read_text()) | {"w": 64, "h": 48, "applied_transform": APPLIED[:3].tolist()}
    file.rename(scene / "transforms.json").write_text(json.dumps(listed))
    return folder, scene


def test_a_placed_camera_sees_what_its_photograph_shows(run):
    folder, source = run
    scene = load_scene(source)
    wrapped = wrap_model(folder, cameras=scene, backend="reference")
    for original, camera in zip(scene.cameras, wrapped.cameras, strict=True):
        image = wrapped.render(camera).image.clamp(0, 1)
        assert psnr(image, scene.image(original, (0, 0, 0))) > 50  # 8 bits


def test_photographs_go_with_their_cameras(run):
    scene = load_scene(run[1])
    here = placed(load_model(run[0]), scene)
    assert [here.images[camera] for camera in here.cameras] == [scene.images[camera] for camera in scene.cameras]
    assert here.applied is None and scene.applied is not None


def test_a_checkpoint_without_cameras_is_judged_by_those_of_its_scene(run):
    model = wrap_model(run[0], backend="reference")
    rows = all_rows(model, evaluator_of(model, load_scene(run[1]), "P3"), [1], [])
    assert rows[0].psnr_db > 50


def test_the_scene_of_a_plain_checkpoint_stays_as_it_is(run):
    scene = load_scene(run[1])
    assert placed(tiny.model(), scene) is scene
    assert wrap_model(tiny.model(), cameras=scene).cameras == list(scene.cameras)


def test_the_command_line_places_cameras(run, tmp_path, capsys):
    views = ["--view", "view_1", "--cameras", str(run[1]), "--backend", "reference"]
    assert main(["render", str(run[0]), "--output", str(tmp_path / "pictures"), *views]) == 0
    scene = load_scene(run[1])
    [picture] = (tmp_path / "pictures").iterdir()
    truth = next(scene.image(camera, (0, 0, 0)) for camera in scene.cameras if camera.name == "view_1")
    assert (read_image(picture, (0, 0, 0)) - truth).abs().max() < 2 / 255
    assert main(["inspect", str(run[0])]) == 0
    assert "splatfacto" in capsys.readouterr().out


def test_gsplat_is_placed_by_a_real_colmap_scene_only(shared_data, tmp_path):
    pytest.importorskip("pycolmap", reason="COLMAP scenes are read by pycolmap, an extra")
    scene = load_scene(shared_data / "colmap/llff_small")
    frame = torch.tensor(np.diag([-1.0, -1.0, 1.0, 1.0]) @ normalized_by_numpy(scene.cameras, scene.points.numpy()))
    means = (scene.points[::20] @ frame[:3, :3].T + frame[:3, 3]).float()
    model = load_model(gsplat_folder(tmp_path / "r", {**splats(len(means)), "means": means}))
    here = placed(model, scene)
    center = frame[:3, :3] @ scene.cameras[7].center + frame[:3, 3]
    assert torch.allclose(here.cameras[7].center, center)
    assert (here.cameras[7].width, len(here.images)) == (136, 31)
    assert torch.stack([camera.center for camera in here.cameras]).norm(dim=1).median() < 3
    with pytest.raises(SceneError, match="give the COLMAP scene"):
        placed(model, replace(scene, points=None))


def test_without_pycolmap_the_frame_of_others_still_works(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert len(wrap_model(run[0], cameras=load_scene(run[1])).cameras) == 4
