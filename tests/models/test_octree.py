"""Octree-GS: its levels follow distance and zoom as in its own project; the rest it shares with Scaffold-GS."""

from dataclasses import replace

import anchor_checkpoints as checkpoints
import anchor_oracle as oracle
import numpy as np
import ply_files
import pytest
import torch
from anchor_checkpoints import STANDARD, VOXEL, Layout
from anchor_models import VIEWS, agrees, assert_adapts, assert_decoded, assert_saved, gain, load, refused

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.backends.supersample import of_samples
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation.measure import baselines, supersampled
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.torchscript import read_torchscript
from mipmap_plugin.models import load_model
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

ALL = ("opacity_mlp", "cov_mlp", "color_mlp")

LAYOUTS = {
    "plain": Layout("octree"),
    "floor, distance": Layout("octree", distance=ALL, to_level="floor"),
    "ceil, level": Layout("octree", level=True, to_level="ceil"),
    "progressive, bank": Layout("octree", bank=True, to_level="progressive"),
    "everything": Layout("octree", distance=("color_mlp",), level=True, bank=True, appearance=(4, 2), united=True, to_level="progressive"),
}


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("zoom", [1, 0.5, 3])
def test_decoding_agrees_with_the_formulas_in_float64(tmp_path, name, zoom):
    assert_decoded(tmp_path, LAYOUTS[name], zoom, count=80)


def test_zoom_chooses_the_levels_and_size_does_not(tmp_path):
    model, view = load(tmp_path, LAYOUTS["plain"], count=80), VIEWS[0]
    counts = [len(model.gaussians(view.zoomed(zoom))) for zoom in (1 / 8, 1 / 4, 1 / 2, 1, 2)]
    assert counts == sorted(counts) and counts[0] < counts[-1] / 2
    assert len(model.gaussians(view.resized(view.width // 4, view.height // 4))) == counts[3]


def test_real_networks_decode(tmp_path, shared_data):
    """The networks of a published checkpoint with synthetic anchors, since nobody publishes both."""
    layout = Layout("octree", features=32, splats=10)
    ply = checkpoints.write(tmp_path / "model", layout)
    for name in ALL:
        (ply.parent / f"{name}.pt").write_bytes((shared_data / "checkpoints/octree_mlps" / f"{name}.pt").read_bytes())
    states = {name: {key: held.numpy() for key, held in read_torchscript(ply.parent / f"{name}.pt").items()} for name in ALL}
    agrees(load_model(tmp_path / "model").gaussians(VIEWS[0]), oracle.decode(checkpoints.columns(layout), states, layout, VIEWS[0]))


@pytest.mark.parametrize("draw", [lambda model, view: model.render(view, 1 / 4, "scaled", 4).image, lambda *given: measured(*given)])
def test_supersampled_it_shows_the_levels_of_its_samples(tmp_path, draw):
    """As its own project does that renders so many pixels; the levels of the small picture alone are coarser."""
    wrapped = wrap_model(load(tmp_path, LAYOUTS["plain"], count=80), cameras=VIEWS)
    truth = resize(wrapped.render(VIEWS[0]).image.clamp(0, 1), VIEWS[0].zoomed(1 / 4).size, "box")
    assert psnr(draw(wrapped, VIEWS[0].zoomed(1 / 4)).clamp(0, 1), truth) > 40


def measured(model, view):
    """The supersampled base of `evaluate` and `tradeoff`."""
    [found] = [each for each in baselines(model, 1 / 4, "box", filters=(), samples=(4,)) if each.name == supersampled(4)]
    return found.render(VIEWS[0])


@pytest.mark.parametrize("lens", [0.5, 1.0, 4.0])
def test_samples_through_any_lens_show_the_levels_that_the_base_shows_through_it(lens):
    whole = replace(VIEWS[0], zoom=lens, base_zoom=lens)
    assert of_samples(whole.zoomed(1 / 4), 16).zoom == of_samples(whole, 2).zoom == lens


# Which networks take what


@pytest.mark.parametrize("bank", [False, True])
@pytest.mark.parametrize("level", [False, True])
@pytest.mark.parametrize("distance", [(), ("opacity_mlp",), ALL])
def test_the_inputs_follow_from_shapes_and_options(tmp_path, distance, level, bank):
    notes = load(tmp_path, Layout("octree", distance=distance, level=level, bank=bank)).notes
    inputs = [note for note in notes if " goes into " in note]
    takers = ", ".join(name for name in ALL if name in distance)
    wanted = [f"the distance of the camera goes into {takers}"] if distance else []
    assert inputs == wanted + ([f"the anchor's level goes into {', '.join(ALL)}{', feature_bank_mlp' * bank}"] if level else [])


def test_without_options_shapes_decide_and_ambiguous_ones_are_refused(tmp_path):
    refused(checkpoints.write(tmp_path / "a", Layout("octree", level=True), cfg=False), "may be the distance or the level; put the cfg_args")
    model = load(tmp_path, Layout("octree", level=True, bank=True), cfg=False)
    assert any("level goes into opacity_mlp" in note for note in model.notes)
    assert any("the original's defaults are taken: fork 2, round" in note for note in model.notes)


# Adapting and saving


@pytest.mark.parametrize(("scale", "least"), [(1 / 4, 0.8), (4, 0.3)])
def test_adapting_gains_and_leaves_the_base_and_what_is_frozen(tmp_path, scale, least):
    assert_adapts(load(tmp_path, LAYOUTS["plain"]), scale, least, steps=40)


def test_the_report_counts_the_splats_of_the_new_scales_levels(tmp_path):
    model = load(tmp_path, LAYOUTS["plain"], count=80)
    adapted = wrap_model(model, cameras=VIEWS).adapt(1 / 4, views="given", steps=1)
    report, view = adapted.report, VIEWS[0].zoomed(1 / 4)
    shown = len(adapted.model.gaussians(view))
    assert (report.gaussians_before, report.gaussians_after) == (len(model.gaussians(view)), shown)
    assert report.curve[-1].gaussians == shown


def test_it_is_told_how_the_original_chooses_the_levels_of_the_new_scale(tmp_path):
    wrapped = wrap_model(load(tmp_path, LAYOUTS["plain"]), cameras=VIEWS)
    with pytest.warns(UserWarning, match=r"levels of detail for x0\.25 only with resolution_scales=\[4\] in its cfg_args"):
        adapted = wrapped.adapt(1 / 4, views="given", steps=1)
    assert "resolution_scales=[4]" in adapted.report.notes[-1]


def test_nothing_is_told_of_levels_where_there_is_one(tmp_path):
    model = load(tmp_path, LAYOUTS["plain"], level=np.zeros(40))
    assert model.traits.shrink_option == ""


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_round_trip_repeats_the_rows_and_the_networks_byte_for_byte(tmp_path, name):
    assert_saved(tmp_path, LAYOUTS[name])


def test_the_constants_survive_the_loss_of_their_rows(tmp_path):
    student = load(tmp_path, LAYOUTS["ceil, level"]).copy()
    keep = torch.arange(40) >= 2
    student.replace_parameters({name: held.detach()[keep] for name, held in student.parameters().items()})
    ply = read_ply(student.save(tmp_path / "saved", provenance={}))
    assert ply.columns["info"].tolist() == [np.float32(VOXEL), np.float32(STANDARD), *[0.0] * 36]
    assert list(ply.columns)[:7] == ["x", "y", "z", "level", "extra_level", "info", "f_offset_0"]
    assert ply.columns["level"].tolist() == checkpoints.columns(LAYOUTS["ceil, level"])["level"][2:].tolist()
    again = load_model(tmp_path / "saved").gaussians(VIEWS[0])
    assert torch.equal(again.means, student.gaussians(VIEWS[0]).means.detach())


@pytest.mark.parametrize("min_opacity", [0.9, 0.999999])
def test_pruning_leaves_the_coarsest_level_and_a_file_that_shows_the_same(tmp_path, min_opacity):
    faint = checkpoints.columns(LAYOUTS["plain"])["level"] == 0  # of no features, in other words
    features = {f"f_anchor_feat_{i}": np.where(faint, 0.0, checkpoints.columns(LAYOUTS["plain"])[f"f_anchor_feat_{i}"]) for i in range(8)}
    _, adapted = gain(load(tmp_path, LAYOUTS["plain"], **features), 1 / 4, steps=3, prune_every=2, min_opacity=min_opacity)
    levels = read_ply(adapted.save(tmp_path / "saved", provenance={})).columns["level"]
    assert 2 <= len(levels) < 40 and levels.min() == 0
    view = VIEWS[0].zoomed(4)  # which asks for the finest
    assert torch.equal(load_model(tmp_path / "saved").gaussians(view).means, adapted.gaussians(view).means.detach())


def test_a_single_anchor_cannot_hold_the_constants(tmp_path):
    student = load(tmp_path, LAYOUTS["plain"]).copy()
    student.replace_parameters({name: held.detach()[:1] for name, held in student.parameters().items()})
    with pytest.raises(SettingsError, match="needs two anchors"):
        student.save(tmp_path / "saved", provenance={})


def test_a_folder_without_cfg_args_gets_what_the_original_asks_for(tmp_path):
    load(tmp_path, LAYOUTS["everything"], cfg=False).save(tmp_path / "saved", provenance={})
    text = (tmp_path / "saved/cfg_args").read_text()
    for option in ("fork=2", "add_level=True", "dist2level='round'", "appearance_dim=2", "use_feat_bank=True", "add_color_dist=True"):
        assert option in text


# What is damaged


@pytest.mark.parametrize("info", [[0.0, 1.0], [1.0, np.nan], [-1.0, 1.0]])
def test_constants_that_are_none_are_refused(tmp_path, info):
    columns = checkpoints.columns(LAYOUTS["plain"])
    columns["info"][:2] = info
    ply = checkpoints.write(tmp_path / "model", LAYOUTS["plain"])
    refused(ply_files.write(ply, columns), "no voxel size and standard distance")


def test_options_that_make_no_levels_are_refused(tmp_path):
    refused(checkpoints.write(tmp_path / "model", Layout("octree", to_level="sideways")), "dist2level='sideways', which make no levels")
