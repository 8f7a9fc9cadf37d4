"""Scaffold-GS is adapted: anchors stay, networks and splats may change."""

import json
from dataclasses import replace

import anchor_checkpoints as checkpoints
import anchor_oracle as oracle
import numpy as np
import pytest
import torch
from anchor_checkpoints import Layout
from anchor_models import VIEWS, assert_adapts, gain, is_same, state_of

from mipmap_plugin.cli import main
from mipmap_plugin.errors import SettingsError, ShapeError
from mipmap_plugin.models import load_model
from mipmap_plugin.recipes import recipe
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")


@pytest.mark.parametrize(("scale", "least"), [(1 / 4, 1.0), (4, 4.0)])
def test_adapting_gains_and_leaves_the_base_and_what_is_frozen(folder, scale, least):
    assert_adapts(load_model(folder), scale, least, steps=30 if scale < 1 else 5)


def test_networks_that_move_gain_more_than_those_that_a_rate_of_0_keeps(folder):
    model = load_model(folder)
    gained, _ = gain(model, 1 / 4)
    kept, adapted = gain(model, 1 / 4, rates=recipe("default", 1 / 4).rates.model_copy(update={"networks": 0.0}))
    assert gained > kept
    assert is_same(model.shared_parameters(), {name: held.detach() for name, held in adapted.shared_parameters().items()})


def test_the_closed_form_stretches_an_anchors_splats(folder):
    model = load_model(folder)
    student = model.copy()
    student.reshape(lambda g: (g.scales * torch.tensor([0.5, 1.0, 2.0]), g.opacities * 0.1), VIEWS)
    before, after = state_of(model), state_of(student)
    stretched = after["scales"][:, 3:] - before["scales"][:, 3:]
    shown = model.row_opacities(VIEWS[::2]) > 0  # of the views that the closed form looks at
    torch.testing.assert_close(stretched[shown], torch.tensor([0.5, 1.0, 2.0]).log().expand(int(shown.sum()), -1))
    assert (stretched[~shown] == 0).all()
    assert {name for name in before if not torch.equal(before[name], after[name])} == {"scales"}
    assert torch.equal(after["scales"][:, :3], before["scales"][:, :3])


def test_a_splat_that_is_flat_does_not_stretch_its_anchor(folder):
    """The least width that the closed form gives it is thousands of times its own, and for the next view it may be round."""
    model = load_model(folder)
    student = model.copy()
    for each in (model, student):
        with torch.no_grad():
            each.shared_parameters()["cov_mlp.2.bias"][0] = -30.0  # the first axis of the first of three splats
    student.reshape(lambda g: (g.scales.clamp_min(1e-4), g.opacities), VIEWS)
    several = model.row_opacities(VIEWS[::2]) > 0
    stretched = (student.parameters()["scales"] - model.parameters()["scales"]).detach()[several]
    assert float(stretched.median()) < 1e-3 and float(stretched.mean()) < 0.5


def test_a_zoom_out_leaves_anchors_out_and_the_report_says_how_many(folder, monkeypatch):
    model = load_model(folder)
    whole = wrap_model(model, cameras=VIEWS).adapt(1 / 4, views="given", steps=1)
    assert "40 of 40 anchors are left; the splats counted are those of one view" in whole.report.notes  # few splats a pixel
    monkeypatch.setattr("mipmap_plugin.adaptation.start.thinning.PER_PIXEL", 0.0)
    adapted = wrap_model(model, cameras=VIEWS).adapt(1 / 4, views="given", steps=1, merge_to=0.5, merging_costs=99)
    kept = len(adapted.model.parameters()["means"])
    assert adapted.report.returned.startswith(("the start, the closed form of a part of the base", "the last state"))
    assert kept == 20
    assert f"{kept} of 40 anchors are left; the splats counted are those of one view" in adapted.report.notes
    assert "what the anchors share has changed too: color_mlp, cov_mlp, opacity_mlp" in adapted.report.notes


@pytest.mark.parametrize("steps", [0, 2])
def test_the_curve_counts_splats_and_no_anchors(folder, steps):
    report = wrap_model(load_model(folder), cameras=VIEWS).adapt(1 / 4, views="given", steps=steps, returns="last").report
    assert report.curve[-1].gaussians == report.gaussians_after > len(load_model(folder).parameters()["means"])


def test_no_number_of_splats_can_be_asked_of_anchors(folder):
    with pytest.raises(SettingsError, match="leave most_splats"):
        wrap_model(load_model(folder), cameras=VIEWS).adapt(1 / 4, most_splats=10)


def test_an_anchor_is_as_opaque_as_its_most_opaque_splat_gets(folder):
    layout, columns, most = Layout(), checkpoints.columns(Layout()), np.zeros(40)
    for i in range(40):
        one = {name: float(column[i]) for name, column in columns.items()}
        anchor = np.array([one["x"], one["y"], one["z"]])
        for view in VIEWS:
            for splat in oracle.splats(one, anchor, anchor - view.center.numpy(), checkpoints.weights(layout), layout, None):
                most[i] = max(most[i], splat[3])
    model = load_model(folder)
    np.testing.assert_allclose(model.row_opacities(VIEWS).numpy(), most, atol=1e-5)
    with pytest.raises(SettingsError, match="at least one view"):
        model.row_opacities([])


def test_pruning_takes_whole_anchors_and_what_belongs_to_them(folder, tmp_path):
    model = load_model(folder)
    keep = model.row_opacities(VIEWS) >= 0.5
    _, adapted = gain(model, 1 / 4, steps=3, prune_every=2, min_opacity=0.5, merge_to=1.0)
    assert 0 < len(adapted) < 40
    kept = [any(torch.equal(row, old) for old in model.parameters()["carried"][keep]) for row in adapted.parameters()["carried"]]
    assert all(kept)
    adapted.save(tmp_path / "pruned", provenance={})
    assert is_same(state_of(adapted), state_of(load_model(tmp_path / "pruned")))


def test_the_paper_recipe_neither_clones_nor_splits_anchors(folder):
    _, adapted = gain(load_model(folder), 1 / 4, recipe="paper", steps=4, prune_every=2, densify_gradient=1e-9, min_opacity=0.0)
    assert len(adapted) == 40


def test_without_cameras_an_orbit_goes_around_the_anchors(folder):
    adapted = wrap_model(load_model(folder)).adapt(1 / 16, steps=1, extra_views=2)
    assert adapted.report.views == "2 views of a generated orbit at 24 px (the checkpoint came without cameras)"


def test_inspecting_examines_what_a_view_shows(folder, capsys):
    assert main(["inspect", str(folder), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["family"], report["sh degree"]) == ("scaffold", "0 in use of 0")
    assert report["splats"] > 5


def test_training_views_beside_the_model_are_numbered(folder):
    write_cameras(folder / "cameras.json", [replace(view, split="test" if i < 2 else "train") for i, view in enumerate(VIEWS)])
    (folder / "cfg_args").write_text(checkpoints.cfg_args(Layout()).replace("eval=False", "eval=True"))
    assert [camera.index for camera in wrap_model(folder).cameras] == [None, 0, 1, 2, 3, 4]


def test_parameters_of_another_shape_are_refused(folder):
    model = load_model(folder).copy()
    with pytest.raises(ShapeError, match=r"features: expected shape \[N, 8\], got \[40, 7\]"):
        model.replace_parameters({**model.parameters(), "features": torch.zeros(40, 7)})
