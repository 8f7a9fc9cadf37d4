"""Scaffold-GS: decoded as in its own project, adapted, and saved so that its own reader takes it."""

import json
from dataclasses import replace

import anchor_checkpoints as checkpoints
import anchor_oracle as oracle
import numpy as np
import ply_files
import pytest
import tiny
import torch
from anchor_checkpoints import Layout

from mipmap_plugin.adaptation.target.base_images import BaseImages
from mipmap_plugin.adaptation.target.pseudo_truth import PseudoTruth
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.cli import main
from mipmap_plugin.errors import CheckpointError, OutputExists, SettingsError, ShapeError
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.models import detect, load_model
from mipmap_plugin.models.anchors.prefilter import in_view
from mipmap_plugin.models.columns import C0
from mipmap_plugin.recipes import recipe
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

LAYOUTS = {
    "plain": Layout(),
    "united": Layout(united=True),
    "distance everywhere": Layout(distance=("opacity_mlp", "cov_mlp", "color_mlp")),
    "distance of colors, appearance": Layout(distance=("color_mlp",), appearance=(5, 4)),
    "feature bank": Layout(bank=True, distance=("opacity_mlp",), appearance=(3, 2), united=True),
}

VIEWS = tiny.cameras(6, width=48, height=36)


@pytest.fixture
def folder(tmp_path):
    checkpoints.write(tmp_path / "model")
    return tmp_path / "model"


def load(tmp_path, layout=Layout(), **options):  # noqa: B008
    checkpoints.write(tmp_path / "model", layout, **options)
    return load_model(tmp_path / "model")


def agrees(gaussians, rows) -> None:
    """The splats are those of the oracle, in its order, to 1e-5."""
    assert len(gaussians) == len(rows) > 5
    shown = [gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.sh[:, 0] * C0 + 0.5]
    for part, values in enumerate(shown, start=1):
        np.testing.assert_allclose(values.detach().numpy(), np.array([row[part] for row in rows]), rtol=0, atol=1e-5)


def state_of(model):
    return {name: held.detach().clone() for name, held in {**model.parameters(), **model.shared_parameters()}.items()}


def is_same(one, other) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


# Reading and decoding


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("zoom", [1, 0.25])
def test_decoding_agrees_with_the_formulas_in_float64(tmp_path, name, zoom):
    layout, view = LAYOUTS[name], VIEWS[1].zoomed(zoom)
    states = checkpoints.weights(layout)
    appearance = states["appearance"]["embedding.weight"].astype(np.float64).mean(0) if layout.appearance else None
    agrees(load(tmp_path, layout).gaussians(view), oracle.decode(checkpoints.columns(layout), states, layout, view, appearance))


def test_a_training_view_sees_its_own_appearance(tmp_path):
    layout = LAYOUTS["distance of colors, appearance"]
    states = checkpoints.weights(layout)
    view = replace(VIEWS[0], index=3)
    model = load(tmp_path, layout)
    agrees(model.gaussians(view), oracle.decode(checkpoints.columns(layout), states, layout, view, states["appearance"]["embedding.weight"][3]))
    with pytest.raises(SettingsError, match="index 5, but the model has the appearance of 5"):
        model.gaussians(replace(view, index=5))


@pytest.mark.parametrize("size", [(48, 36), (5, 3), (17, 16)])
def test_the_prefilter_is_the_originals(size):
    """Anchors all around the camera, most of them on a border."""
    columns = checkpoints.columns(Layout(), count=400, seed=3)
    view = VIEWS[2].resized(*size)
    position, rotation = (torch.from_numpy(np.stack([columns[name] for name in names], 1)) for names in ("xyz", [f"rot_{i}" for i in range(4)]))
    scales = torch.from_numpy(np.stack([columns[f"scale_{i}"] for i in range(3)], 1)).exp()
    position = position * 4
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


# Adapting


def gain(model, scale, **settings):
    """dB against the pseudo truth over the base's own render at the new scale, on the views adapted to; and the adapted model."""
    wrapped = wrap_model(model, cameras=VIEWS)
    adapted = wrapped.adapt(scale, views="given", check_every=10, **{"steps": 30, **settings})
    config = recipe("default", scale, resize="pil-bicubic")
    truth = PseudoTruth(BaseImages(model, adapted.backend, wrapped.effects()), scale, config)

    def decibel(image, view):
        return psnr(resize(image, truth(view).shape[:2], config.resize), truth(view))

    views = VIEWS[:2]
    gained = [decibel(adapted.render(v.zoomed(scale)).image, v) - decibel(wrapped.render(v.zoomed(scale)).image, v) for v in views]
    return sum(gained) / len(views), adapted.model


@pytest.mark.parametrize(("scale", "least"), [(1 / 4, 1.0), (4, 4.0)])
def test_adapting_gains_and_leaves_the_base_and_what_is_frozen(folder, scale, least):
    model = load_model(folder)
    before = state_of(model)
    gained, adapted = gain(model, scale, steps=30 if scale < 1 else 5)
    after = state_of(adapted)
    assert gained > least
    assert is_same(before, state_of(model))
    moved = {"features", "scales", *model.shared_parameters(), *(["offsets"] if scale < 1 else [])}
    assert {name for name in before if not torch.equal(before[name], after[name])} == moved


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


def test_a_baked_view_is_a_plain_file_that_shows_the_same(folder, tmp_path):
    model = load_model(folder)
    baked = load_model(model.bake(VIEWS[0]).save(tmp_path / "view.ply", provenance={}))
    assert baked.family == "3dgs"
    one, other = (wrap_model(shown, cameras=VIEWS).render(VIEWS[0]).image for shown in (model, baked))
    torch.testing.assert_close(one, other, atol=1e-5, rtol=0)


def test_without_cameras_an_orbit_goes_around_the_anchors(folder):
    adapted = wrap_model(load_model(folder)).adapt(1 / 16, steps=1, extra_views=2)
    assert adapted.report.views == "2 views of a generated orbit at 800 px (the checkpoint came without cameras)"


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


# Saving


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_round_trip_repeats_the_rows_and_the_networks_byte_for_byte(tmp_path, name):
    model = load(tmp_path, LAYOUTS[name])
    saved = model.copy().save(tmp_path / "saved", provenance={"scale": 0.25})
    first, second = (place / "point_cloud" / "iteration_30000" for place in (tmp_path / "model", tmp_path / "saved"))
    assert saved == second / "point_cloud.ply"
    assert sorted(p.name for p in first.iterdir()) == sorted(p.name for p in second.iterdir())
    for file in first.iterdir():
        old, new = file.read_bytes(), (second / file.name).read_bytes()
        assert new.split(b"end_header")[-1] == old.split(b"end_header")[-1]
    assert (tmp_path / "saved/cfg_args").read_bytes() == (tmp_path / "model/cfg_args").read_bytes()
    assert is_same(state_of(model), state_of(load_model(tmp_path / "saved")))


def test_the_original_reader_finds_its_columns(folder, tmp_path):
    """scene/gaussian_model.py reads by name and by count, and the viewer by order."""
    ply = read_ply(load_model(folder).save(tmp_path / "a" / "point_cloud.ply", provenance={}))
    wanted = ["x", "y", "z", "nx", "ny", "nz", *(f"f_offset_{i}" for i in range(9)), *(f"f_anchor_feat_{i}" for i in range(8)), "opacity"]
    assert list(ply.columns) == [*wanted, *(f"scale_{i}" for i in range(6)), *(f"rot_{i}" for i in range(4))]
    assert {column.dtype.str for column in ply.columns.values()} == {"<f4"}


@pytest.mark.parametrize("name", ["feature bank", "distance of colors, appearance"])
def test_networks_that_moved_are_written_as_the_original_reads_them(tmp_path, name):
    layout = LAYOUTS[name]
    student = load(tmp_path, layout).copy()
    with torch.no_grad():
        for held in student.shared_parameters().values():
            held.mul_(1.25)
    place = student.save(tmp_path / "moved" / "point_cloud.ply", provenance={}).parent
    assert is_same(state_of(student), state_of(load_model(place / "point_cloud.ply")))
    state = {key: torch.from_numpy(held) * 1.25 for key, held in checkpoints.weights(layout)["opacity_mlp"].items()}
    values = torch.rand(4, layout.inputs("opacity_mlp"))
    if layout.united:
        network = torch.nn.Sequential(torch.nn.Linear(*state["0.weight"].T.shape), torch.nn.ReLU(), torch.nn.Linear(8, 3), torch.nn.Tanh())
        network.load_state_dict(torch.load(place / "checkpoints.pth", weights_only=True)["opacity_mlp"])
    else:
        network = torch.jit.load(place / "opacity_mlp.pt")
        assert torch.jit.load(place / "embedding_appearance.pt")(torch.tensor([4])).shape == (1, 4)
    hidden = (values @ state["0.weight"].T + state["0.bias"]).relu()
    torch.testing.assert_close(network(values), (hidden @ state["2.weight"].T + state["2.bias"]).tanh())


def test_a_folder_without_cfg_args_gets_what_the_original_asks_for(tmp_path):
    load(tmp_path, LAYOUTS["distance of colors, appearance"], cfg=False).save(tmp_path / "saved", provenance={})
    text = (tmp_path / "saved/cfg_args").read_text()
    options = "feat_dim=8", "n_offsets=3", "appearance_dim=4", "add_color_dist=True", "add_cov_dist=False", "use_feat_bank=False", "voxel_size=0.001"
    for option in options:
        assert option in text


def test_other_anchors_networks_are_never_replaced_unasked(folder, tmp_path):
    model = load_model(folder)
    student = model.copy()
    with torch.no_grad():
        student.shared_parameters()["opacity_mlp.0.bias"].add_(1)
    student.save(tmp_path / "b" / "a.ply", provenance={})
    model.save(tmp_path / "c" / "a.ply", provenance={})
    model.save(tmp_path / "c" / "b.ply", provenance={})  # the same networks may serve two
    with pytest.raises(OutputExists, match=r"holds other networks \(opacity_mlp.pt\)"):
        model.save(tmp_path / "b" / "b.ply", provenance={})
    with pytest.raises(OutputExists, match="holds other networks"):
        student.save(model.source.with_name("adapted.ply"), provenance={}, overwrite=True)
    assert is_same(state_of(load_model(folder)), state_of(model))
    model.save(tmp_path / "b" / "a.ply", provenance={}, overwrite=True)
    assert is_same(state_of(load_model(tmp_path / "b" / "a.ply")), state_of(model))


# What is damaged


def refused(path, sentence) -> None:
    with pytest.raises(CheckpointError, match=sentence) as caught:
        load_model(path)
    assert "\n" not in str(caught.value)


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
    refused(ply, "none of its 40 anchors is finite")


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
