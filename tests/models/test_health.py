"""Health: each fault is counted once and by its own name, and only poison is dropped unasked."""

import json
import math

import numpy as np
import pytest
import tiny
import torch
from ply_files import splat_columns, write

from mipmap_plugin.cli import main
from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.models import load_model
from mipmap_plugin.models.health import ACTIVATED, LINEAR, examine, units
from mipmap_plugin.models.live import adopt
from mipmap_plugin.models.reading import drop, load_vanilla
from mipmap_plugin.models.vanilla import VanillaModel

FIELDS = {"means": "x", "scales": "scale_1", "quats": "rot_2", "opacities": "opacity", "sh0": "f_dc_1", "shN": "f_rest_7"}


def healthy(count: int = 200) -> VanillaModel:
    torch.manual_seed(0)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (0, 3)}
    raw = {name: torch.randn(count, *shape) for name, shape in shapes.items()}
    return VanillaModel({**raw, "scales": raw["scales"] - 4})


def spoiled(name: str, row: int, value) -> VanillaModel:
    model = healthy()
    model.parameters()[name][row] = torch.as_tensor(value, dtype=torch.float32)
    return model


def test_a_healthy_model_has_nothing_to_report():
    health = examine(healthy())
    assert health.sentences() == []
    assert not health.invalid.any()


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("quats", [0.0] * 4, "1 of 200 splats has a zero quaternion"),
        ("scales", [9.0, 0, 0], "1 of 200 splats is longer than the scene"),
        ("scales", [-30.0, 0, 0], "1 of 200 splats has an axis below"),
        ("opacities", -6.0, "1 of 200 splats has an opacity below 1/255"),
    ],
)
def test_oddities_are_counted_and_kept(name, value, sentence):
    health = examine(spoiled(name, 7, value))
    assert [sentence_found for sentence_found in health.sentences() if sentence_found.startswith(sentence)]
    assert len(health.sentences()) == 1
    assert not health.invalid.any()


@pytest.mark.parametrize(("name", "value"), [("opacities", -6.0), ("scales", -math.inf), ("scales", -40.0)])
@pytest.mark.parametrize("share", [0.5, 0.68])
def test_a_file_most_of_which_shows_nothing_is_told_in_the_verdict(tmp_path, capsys, name, value, share):
    model = healthy()
    model.parameters()[name][: int(share * 200)] = value
    told = "68% of its splats show nothing, for their opacity is below 1/255 or their size is 0" if share > 0.5 else ""
    assert examine(model).mostly_unseen() == told
    assert main(["inspect", str(model.save(tmp_path / "a.ply", provenance={})), "--no-viewers"]) == 0
    assert (f"verdict:      sound, but {told}; next: " in capsys.readouterr().out) == bool(told)


@pytest.mark.parametrize(("most", "told"), [(0.01, True), (0.03, False), (0.003, False)])  # the last: all are invisible, which is told instead
def test_a_scene_as_faint_as_after_a_reset_of_opacities_is_told_of(most, told):
    model = healthy()
    model.parameters()["opacities"].clamp_(max=math.log(most / (1 - most)))
    health = examine(model)
    assert any(each.startswith("200 of 200 splats have an opacity below 2 %") for each in health.sentences()) == told
    assert health.spoilt() == (most < 1 / 255)  # it may be meant so


def test_surfels_have_no_third_axis_and_are_no_sheets_for_it():
    surfels = healthy()
    surfels.parameters()["scales"][:, 2] = -30.0
    assert examine(surfels).tiny == 0
    surfels.parameters()["scales"][3, 0] = -30.0
    assert examine(surfels).tiny == 1


@pytest.mark.parametrize("logit", [math.log(1 / 254) - 1e-4, math.log(1 / 254) + 1e-4])
def test_invisible_is_below_one_eight_bit_step(logit):
    assert examine(spoiled("opacities", 0, logit)).invisible == (logit < math.log(1 / 254))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", FIELDS)
def test_poison_in_one_row_is_dropped_at_load_with_a_note(tmp_path, field, value):
    columns = splat_columns(8)
    columns[FIELDS[field]][3] = value
    model = load_vanilla(write(tmp_path / "a.ply", columns))
    if (field == "opacities" and not math.isnan(value)) or (field == "scales" and value == -math.inf):  # opacity 0 or 1, length 0
        assert len(model) == 8 and not model.notes
        return
    assert model.notes[0] == f"1 of 8 splats was dropped: 1 of 8 splats holds {'a NaN' if math.isnan(value) else 'an infinity'} in {field}"
    rows = [i for i in range(8) if i != 3]
    np.testing.assert_array_equal(model.parameters()["means"], np.stack([columns[axis][rows] for axis in "xyz"], 1))


@pytest.mark.parametrize("log_scale", [89.0, 45.0])
def test_scales_whose_variance_overflows_are_poison(log_scale):
    health = examine(spoiled("scales", 5, [log_scale, 0, 0]))
    assert health.invalid.nonzero().tolist() == [[5]]


def test_strays_do_not_set_the_extent():
    assert examine(spoiled("means", 0, [1e9, 0, 0])).extent < 10


@pytest.mark.parametrize(("name", "flag"), [("scales", "scales_look_linear"), ("opacities", "opacities_look_activated")])
def test_values_that_look_activated_are_reported_and_not_changed(name, flag):
    model = healthy()
    model.parameters()[name].uniform_(0.01, 0.9)
    before = model.parameters()[name].clone()
    health = examine(model)
    assert getattr(health, flag)
    assert any("export the file again" in sentence_found for sentence_found in health.sentences())
    assert torch.equal(model.parameters()[name], before)


@pytest.mark.usefixtures("brief_ladders")
@pytest.mark.parametrize(("column", "sentence"), [("scale_{}", LINEAR), ("opacity", ACTIVATED)])
@pytest.mark.parametrize("words", [["adapt", "--scale", "1/2", "--recipe", "instant"], *(
    ["levels", "--viewer", "playcanvas", "--coarsest", "1/2", "--steps", "1", "--by", by] for by in ("zoom", "distance"))])  # fmt: skip
def test_what_inspect_calls_doubtful_is_told_of_once_and_in_the_report(tmp_path, capsys, words, column, sentence):
    path = tiny.folder(tmp_path / "base", count=120)
    [ply] = path.rglob("*.ply")
    columns = read_ply(ply).columns
    wrong = {name: np.float32(1) / (1 + np.exp(-values)) for name, values in columns.items() if name in (column, *map(column.format, range(3)))}
    write(ply, columns | wrong)
    command, *options = words
    assert main([command, str(path), *options, "--output", str(tmp_path / "new"), "--views", "given"]) == 0
    assert capsys.readouterr().err.count(sentence) == 1
    reports = sorted((tmp_path / "new").rglob("*.adaptation.json"))
    assert reports and all(json.loads(report.read_text())["notes"][0] == sentence for report in reports)


@pytest.mark.parametrize("left", [0, 20, 21])
def test_a_file_of_which_little_is_finite_is_refused_and_the_byte_order_named(tmp_path, left):
    columns = splat_columns(100)
    columns["x"][left:] = 1e20
    path = write(tmp_path / "a.ply", columns)
    few = f"only {left} of 100 splats are" if left else "none of 100 splats is"
    told = rf"a.ply: {few} finite once activated, and below 1e\+12; its header may name the wrong byte order, or the training .* export it again"
    with pytest.raises(CheckpointError, match=told) if left < 21 else pytest.warns(UserWarning, match="79 of 100 splats were dropped"):
        load_vanilla(path)


def test_a_few_splats_say_nothing_about_distributions():
    model = healthy(3)
    model.parameters()["opacities"].fill_(0.5)
    assert not examine(model).opacities_look_activated


@pytest.mark.parametrize("count", [0, 1])
def test_nearly_empty_models(count):
    health = examine(healthy(count))
    assert (health.splats, health.extent, health.huge, len(health.invalid)) == (count, 0.0, 0, count)


def test_drop_takes_rows_of_every_field_and_of_extra_columns(tmp_path):
    model = load_vanilla(write(tmp_path / "a.ply", {**splat_columns(4), "segment": np.arange(4, dtype=np.int32)}))
    with pytest.warns(UserWarning, match="here: 2 of 4 splats were dropped: too dark"):
        left = drop(model, torch.tensor([False, True, False, True]), "too dark", "here")
    saved = load_vanilla(left.save(tmp_path / "b.ply", provenance={}))
    assert len(model) == 4 and model.notes == ["extra columns are carried along: segment"]
    assert left.notes[-1] == "2 of 4 splats were dropped: too dark"
    assert saved._origin.extras["segment"].tolist() == [0, 2]
    assert torch.equal(left.parameters()["shN"], model.parameters()["shN"][[0, 2]])


def test_real_checkpoints(shared_data):
    flowers = examine(load_model(shared_data / "checkpoints/flowers_r8"))
    assert (flowers.tiny, flowers.invisible, flowers.scales_look_linear) == (9_878, 4_838, False)
    assert examine(load_model(shared_data / "checkpoints/vanilla_iter7000")).sentences() == []


def test_a_checkpoint_of_which_nothing_is_drawn_is_spoilt():
    faint = healthy()
    faint.parameters()["opacities"][:] = -20
    assert examine(faint).spoilt() and not examine(spoiled("opacities", 0, -20.0)).spoilt()


def far_away(kind: type) -> dict[str, np.ndarray]:
    """A scene of some units in UTM coordinates, and splats of a hundredth of it."""
    columns = splat_columns(200)
    places = {axis: columns[axis].astype(np.float64) + offset for axis, offset in zip("xyz", (5e5, 5.5e6, 100.0), strict=True)}
    return {**columns, **{axis: place.astype(kind) for axis, place in places.items()}, **{f"scale_{i}": columns[f"scale_{i}"] - 4 for i in range(3)}}


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_places_that_float32_does_not_hold_are_told_of_once(tmp_path, kind):
    with pytest.warns(UserWarning, match=r"200 of 200 splats lie so far .* steps of 0.5 units") as caught:
        model = load_vanilla(write(tmp_path / "utm.ply", far_away(kind)))
    assert len(caught) == 1 and examine(model).spoilt() and examine(model).sentences() == model.notes
    assert adopt(model) is model  # nor told of again


def test_places_that_float32_holds_well_enough_are_not_told_of():
    near, points = healthy(), spoiled("scales", slice(None), -20.0)
    near.parameters()["means"].add_(1000)
    assert examine(near).rounded == examine(points).rounded == 0  # nor is the place of a point rounded, in an image of all
    stray = examine(spoiled("means", 0, 1e9))
    assert stray.rounded == 1 and not stray.doubts()  # floaters lie anywhere


def test_only_what_dropped_splats_hold_is_told(tmp_path):
    columns = splat_columns(8)
    columns["x"][3], columns["opacity"][3:5], columns["f_dc_0"][6], columns["scale_0"][7] = np.nan, np.inf, 1e13, -np.inf
    model = load_vanilla(write(tmp_path / "a.ply", columns))
    told = "1 of 8 splats holds a NaN in means; 1 of 8 splats is above 1e+12 once activated"
    assert model.notes == [f"2 of 8 splats were dropped: {told}"]


def test_lengths_have_no_power_of_ten():
    assert [units(length, 2) for length in (0.0123, 1.26, 99.7, 123.4, 45678.0)] == ["0.012", "1.3", "100", "123", "45,678"]
