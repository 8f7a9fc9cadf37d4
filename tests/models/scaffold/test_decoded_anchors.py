"""Scaffold-GS is decoded as in its own project, and what is damaged is refused in a sentence."""

from dataclasses import replace

import anchor_checkpoints as checkpoints
import anchor_oracle as oracle
import numpy as np
import ply_files
import pytest
import torch
from anchor_checkpoints import Layout
from anchor_models import LAYOUTS, VIEWS, agrees, assert_decoded, load, refused

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.models import detect, load_model
from mipmap_plugin.models.anchors.prefilter import in_view

pytestmark = pytest.mark.usefixtures("few_views")


# Reading and decoding


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("zoom", [1, 0.25])
def test_decoding_agrees_with_the_formulas_in_float64(tmp_path, name, zoom):
    assert_decoded(tmp_path, LAYOUTS[name], zoom)


def test_a_training_view_sees_its_own_appearance(tmp_path):
    layout = LAYOUTS["distance of colors, appearance"]
    states = checkpoints.weights(layout)
    view = replace(VIEWS[0], index=3)
    model = load(tmp_path, layout)
    agrees(model.gaussians(view), oracle.decode(checkpoints.columns(layout), states, layout, view, states["appearance"]["embedding.weight"][3]))
    for index in (5, -1):
        with pytest.raises(SettingsError, match=f"index {index}, but the model has the appearance of 5"):
            model.gaussians(replace(view, index=index))


@pytest.mark.parametrize("size", [(48, 36), (5, 3), (17, 16)])
def test_the_prefilter_is_the_originals(size):
    """Anchors all around the camera, most of them on a border."""
    columns = checkpoints.columns(Layout(), count=400, seed=3)
    view = VIEWS[2].resized(*size)
    position, rotation = (torch.from_numpy(np.stack([columns[name] for name in names], 1)) for names in ("xyz", [f"rot_{i}" for i in range(4)]))
    scales = torch.from_numpy(np.stack([columns[f"scale_{i}"] for i in range(3)], 1)).exp()
    position = position * 4
    position[:20] = (view.center + torch.linspace(0.05, 0.4, 20)[:, None] * view.viewmat[2, :3]).float()  # on either side of the near plane
    seen = in_view(position, scales, torch.nn.functional.normalize(rotation), view)
    rows = [{**{name: float(column[i]) for name, column in columns.items()}} for i in range(400)]
    wanted = [oracle.visible(row, position[i].double().numpy(), view) for i, row in enumerate(rows)]
    assert seen.tolist() == wanted
    assert 20 < sum(wanted) < 380


def test_notes_describe_the_layout(tmp_path):
    notes = load(tmp_path, LAYOUTS["feature bank"]).notes
    assert "40 anchors with 3 splats each, which are decoded for each camera" in notes
    assert "the distance of the camera goes into opacity_mlp, feature_bank_mlp" in notes
    assert any("appearance for each of 3 training views" in note for note in notes)


def test_a_bare_ply_finds_the_networks_beside_it(folder):
    model = load_model(folder / "point_cloud/iteration_30000/point_cloud.ply")
    assert (model.family, model.folder) == ("scaffold", folder)


def test_gradients_reach_what_may_move_and_not_the_anchors(folder):
    model = load_model(folder).copy()
    shown = model.gaussians(VIEWS[0])
    (shown.means.sum() + shown.scales.sum() + shown.opacities.sum() + shown.sh.sum()).backward()
    moved = {name for name, held in model.parameters().items() if held.grad is not None and held.grad.abs().sum() > 0}
    assert moved == {"offsets", "features", "scales"}
    assert all(held.grad is not None for held in model.shared_parameters().values())


# What is damaged


def test_an_incomplete_iteration_is_passed_over_for_an_older_whole_one(folder, tmp_path):
    newest = checkpoints.write(tmp_path / "other", iteration=40_000).parent
    newest.rename(folder / "point_cloud" / "iteration_40000")
    (folder / "point_cloud/iteration_40000/cov_mlp.pt").unlink()
    checkpoint = detect(folder)
    assert (checkpoint.iteration, checkpoint.family) == (30_000, "scaffold")
    assert "incomplete checkpoint, without cov_mlp.pt" in checkpoint.notes[0]
    refused(folder / "point_cloud/iteration_40000/point_cloud.ply", "incomplete checkpoint: cov_mlp.pt must lie beside the PLY")


def test_a_missing_appearance_is_named(tmp_path):
    ply = checkpoints.write(tmp_path / "model", LAYOUTS["distance of colors, appearance"])
    (ply.parent / "embedding_appearance.pt").unlink()
    refused(ply, "embedding_appearance.pt is missing")


@pytest.mark.parametrize(
    ("layout", "sentence"),
    [(Layout(splats=4), "opacity_mlp gives 4 numbers, but anchors with 3 splats need 3"), (Layout(features=10), "opacity_mlp takes 2 numbers more")],
)
def test_networks_of_another_checkpoint_are_refused(folder, layout, sentence):
    place = folder / "point_cloud/iteration_30000"
    checkpoints.write_networks(place, layout, checkpoints.weights(layout))
    refused(folder, sentence)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda states: states["opacity_mlp"].pop("0.bias"), "opacity_mlp holds 0.weight, 2.bias, 2.weight, not"),
        (lambda states: states["cov_mlp"].update({"2.bias": np.zeros(5, np.float32)}), "layers of cov_mlp do not fit"),
        (lambda states: states["color_mlp"]["2.bias"].fill(np.nan), "color_mlp holds weights that are not finite"),
        (lambda states: states.pop("color_mlp"), "does not hold the networks"),
    ],
)
def test_damaged_networks_are_one_sentence(folder, change, sentence):
    place, layout = folder / "point_cloud/iteration_30000", Layout(united=True)
    states = checkpoints.weights(layout)
    change(states)
    (place / "opacity_mlp.pt").unlink()
    checkpoints.write_networks(place, layout, states)
    refused(folder, sentence)


@pytest.mark.parametrize("missing", ["opacity", "scale_5", "rot_0", "f_offset_8"])
def test_missing_columns_are_named(folder, missing):
    columns = checkpoints.columns(Layout())
    del columns[missing]
    ply_files.write(folder / "point_cloud/iteration_30000/point_cloud.ply", columns)
    refused(folder / "point_cloud/iteration_30000/point_cloud.ply", missing if missing != "f_offset_8" else "8 offsets and 8 features")


def test_anchors_that_are_not_finite_are_dropped_and_counted(tmp_path):
    columns = checkpoints.columns(Layout())
    columns["f_anchor_feat_2"][5], columns["scale_4"][7] = np.nan, 200
    model = load(tmp_path, f_anchor_feat_2=columns["f_anchor_feat_2"], scale_4=columns["scale_4"])
    assert len(model) == 38
    assert "2 of 40 anchors were dropped: not finite" in model.notes
    assert all(bool(held.isfinite().all()) for held in (model.gaussians(VIEWS[0]).means, model.gaussians(VIEWS[0]).scales))


def test_a_checkpoint_without_a_finite_anchor_is_refused(tmp_path):
    ply = checkpoints.write(tmp_path / "model", x=np.full(40, np.nan))
    refused(ply, "none of 40 anchors is finite")


def test_a_column_that_nothing_reads_costs_no_anchor(tmp_path):
    whole = load_model(checkpoints.write(tmp_path / "whole"))
    count = len(whole.parameters()["means"])
    odd = np.full(count, np.nan)
    assert len(load_model(checkpoints.write(tmp_path / "odd", opacity=odd)).parameters()["means"]) == count


def test_integers_that_nothing_reads_stay_integers(tmp_path):
    columns = checkpoints.columns(Layout(), label=np.arange(40)) | {"label": np.arange(40, dtype=np.int32)}
    ply = ply_files.write(checkpoints.write(tmp_path / "model"), columns)
    saved = read_ply(load_model(ply).save(tmp_path / "saved", provenance={})).columns
    assert saved["label"].dtype == np.int32 and saved["label"].tolist() == list(range(40)) and saved["x"].dtype == np.float32
    columns["label"][3] = 2**31 - 1
    with pytest.warns(UserWarning, match="integers above 16,777,216 in label are rounded to float32"):
        large = load_model(ply_files.write(ply, columns))
    assert read_ply(large.save(tmp_path / "large", provenance={})).columns["label"][3] == 2**31 - 1
