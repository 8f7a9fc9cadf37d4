"""Which appearance test views take of models that have one for each training view."""

import json

import anchor_checkpoints as checkpoints
import pytest
import tiny
import torch
from anchor_checkpoints import Layout

from mipmap_plugin.cli import main
from mipmap_plugin.models import load_model
from mipmap_plugin.scenes import Scene, load_scene, write_cameras

WITH = Layout(appearance=(5, 4))


def test_upstream_numbers_test_views_among_themselves(tmp_path):
    views = [*tiny.cameras(2), *tiny.cameras(3, seed=3, split="test")]
    numbered = Scene(tuple(reversed(views)), {}, tmp_path).numbered_as_upstream().cameras
    assert [camera.index for camera in reversed(numbered)] == [None, None, 0, 1, 2]


@pytest.mark.parametrize("family", ["scaffold", "octree"])
def test_a_numbered_test_view_sees_the_appearance_of_that_training_view(tmp_path, family):
    model = load_model(checkpoints.write(tmp_path / "m", Layout(family=family, appearance=(5, 4))))
    [view] = tiny.cameras(1, split="test")
    mean = model.gaussians(view).sh
    [numbered] = Scene((view,), {}, tmp_path).numbered_as_upstream().cameras
    table = model.shared_parameters()["appearance.embedding.weight"]
    table[:] = table[0].clone()
    assert torch.equal(model.gaussians(numbered).sh, model.gaussians(view).sh) and not torch.allclose(mean, model.gaussians(view).sh)


@pytest.mark.parametrize("layout", [WITH, Layout()])
def test_evaluate_says_which_it_took_and_can_take_upstreams(tmp_path, layout, capsys):
    checkpoints.write(tmp_path / "m", layout)
    write_cameras(tmp_path / "m/cameras.json", tiny.cameras())
    tiny.scene(tmp_path / "scene")
    reports = {}
    for appearance in ("mean", "upstream"):
        arguments = ["evaluate", str(tmp_path / "m"), "--images", str(tmp_path / "scene"), "--scale", "1", "--appearance", appearance, "--json"]
        assert main([*arguments, "--no-report"]) == 0
        reports[appearance] = json.loads(capsys.readouterr().out)
    decibels = [reports[appearance]["rows"][0]["psnr_db"] for appearance in reports]
    notes = {appearance: [note for note in facts["notes"] if "appearance" in note] for appearance, facts in reports.items()}
    if layout is WITH:
        assert decibels[0] != decibels[1]
        assert "mean appearance" in notes["mean"][0] and "same number" in notes["upstream"][0]
    else:
        assert decibels[0] == decibels[1] and notes == {"mean": [], "upstream": []}


def test_the_scene_keeps_its_photographs(tmp_path):
    scene = load_scene(tiny.scene(tmp_path / "scene"))
    assert list(scene.numbered_as_upstream().images.values()) == list(scene.images.values())
