"""4D Gaussians: what it reads, shows, adapts and writes."""

from pathlib import Path

import moving
import numpy as np
import pytest
import tiny
import torch

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.models import load_model
from mipmap_plugin.wrap import wrap_model

ALL_ON = "no_do=False, no_dshs=False"


def bilinear(plane, x, y):
    """A plane [C, h, w] at x, y of -1..1 between the centers of its first and last cells; its edge goes on outside."""
    _, h, w = plane.shape
    x, y = np.clip((x + 1) / 2 * (w - 1), 0, w - 1), np.clip((y + 1) / 2 * (h - 1), 0, h - 1)
    left, top = min(int(x), w - 2), min(int(y), h - 2)
    u, v = x - left, y - top
    rows = plane[:, top : top + 2, left : left + 2]
    return (1 - v) * ((1 - u) * rows[:, 0, 0] + u * rows[:, 0, 1]) + v * ((1 - u) * rows[:, 1, 0] + u * rows[:, 1, 1])


def oracle(state, raw, time, *, no_grid=False, static_mlp=False, apply_rotation=False, off=("opacity_deform", "shs_deform")):
    """The activated parameters of one splat in float64."""
    w = {name.removeprefix("deformation_net."): tensor.double().numpy() for name, tensor in state.items()}
    layer = lambda name, h: w[f"{name}.weight"] @ h + w[f"{name}.bias"]  # noqa: E731
    head = lambda name, h: layer(f"{name}.3", np.maximum(layer(f"{name}.1", np.maximum(h, 0)), 0))  # noqa: E731
    high, low = w["grid.aabb"]
    place = [*((raw["means"] - high) * 2 / (low - high) - 1), time]
    features = []
    for scale in range(sum(name.endswith(".0") and name.startswith("grid.grids") for name in w)):
        planes = [w[f"grid.grids.{scale}.{number}"][0] for number in range(6)]
        pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
        features.append(np.prod([bilinear(plane, place[a], place[b]) for plane, (a, b) in zip(planes, pairs, strict=True)], axis=0))
    h = np.array([*raw["means"], time]) if no_grid else np.concatenate(features)
    for number in sorted(int(name.split(".")[1]) for name in w if name.startswith("feature_out") and name.endswith("weight")):
        h = layer(f"feature_out.{number}", np.maximum(h, 0) if number else h)
    m = head("static_mlp", h) if static_mlp else np.ones(1)
    mean, scale = raw["means"] * m + head("pos_deform", h), raw["scales"] * m + head("scales_deform", h)
    turn = head("rotations_deform", h)
    a, b, c, d = raw["quats"]
    product = np.array([[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]]) @ turn
    quat = product if apply_rotation else raw["quats"] + turn
    logit = raw["opacities"] if "opacity_deform" in off else raw["opacities"] * m + head("opacity_deform", h)
    sh = np.concatenate([raw["sh0"], raw["shN"]])
    sh = sh if "shs_deform" in off else sh * m + head("shs_deform", h).reshape(16, 3)
    return mean, np.exp(scale), quat / np.linalg.norm(quat), 1 / (1 + np.exp(-logit)), sh


@pytest.mark.parametrize(
    ("options", "state", "variant"),
    [
        ("", {}, {}),
        (ALL_ON, dict(depth=3), dict(off=())),
        ("apply_rotation=True, no_grid=True", dict(no_grid=True), dict(apply_rotation=True, no_grid=True)),
        (f"{ALL_ON}, static_mlp=True", dict(scales=(1, 2, 3)), dict(static_mlp=True, off=())),
    ],
    ids=["as published", "all heads", "no grid", "static mask"],
)
def test_every_variant_agrees_with_an_independent_evaluation(tmp_path, options, state, variant):
    weights = moving.hexplane_state(**state)
    model = load_model(moving.write_hexplane(tmp_path / "m", options, weights))
    raw = {name: tensor.double().numpy() for name, tensor in model.parameters().items()}
    for time in (0.0, 0.37, 1.0):
        g = model.gaussians(moving.at(time))
        for row in range(0, 60, 7):
            expected = oracle(weights, {name: values[row] for name, values in raw.items()}, time, **variant)
            actual = (g.means[row], g.scales[row], g.quats[row], g.opacities[row], g.sh[row])
            for value, want in zip(actual, expected, strict=True):
                np.testing.assert_allclose(value.numpy(), np.squeeze(want), rtol=1e-5, atol=1e-5)
    assert g.covariances is None


def test_a_switched_off_head_changes_nothing(tmp_path):
    model = load_model(moving.write_hexplane(tmp_path / "m", "no_dx=True, no_ds=True, no_dr=True"))
    moved, canonical = model.gaussians(moving.at(0.8)), model.canonical.gaussians()
    assert all(torch.equal(getattr(moved, name), getattr(canonical, name)) for name in ("means", "scales", "quats", "opacities", "sh"))


def test_without_cfg_args_the_published_defaults_are_used_and_noted(tmp_path):
    folder = moving.write_hexplane(tmp_path / "m")
    with_options = load_model(folder).gaussians(moving.at(0.5))
    (folder / "cfg_args").unlink()
    model = load_model(folder)
    assert torch.equal(model.gaussians(moving.at(0.5)).means, with_options.means)
    assert any("opacities and colors are taken to stay" in note for note in model.notes)


def test_the_field_has_no_gradient_and_the_splats_do(tmp_path):
    student = load_model(moving.write_hexplane(tmp_path / "m", ALL_ON)).copy()
    g = student.gaussians(moving.at(0.5))
    sum(tensor.sum() for tensor in (g.means, g.scales, g.quats[:, 0], g.opacities, g.sh)).backward()
    assert all(bool((tensor.grad != 0).any()) for tensor in student.parameters().values())
    assert student.shared_parameters() == {}


def test_a_splat_counts_as_opaque_as_it_ever_gets(tmp_path):
    model = load_model(moving.write_hexplane(tmp_path / "m", ALL_ON))
    views = [moving.at(time) for time in (0.0, 0.5, 1.0)]
    expected = torch.stack([model.gaussians(view).opacities for view in views]).amax(0)
    assert torch.equal(model.row_opacities(views), expected)
    assert not torch.equal(expected, model.canonical.row_opacities())


def test_what_is_saved_loads_again_and_is_laid_out_as_the_project_reads_it(tmp_path):
    folder = moving.write_hexplane(tmp_path / "m", ALL_ON)
    base = load_model(folder)
    saved = base.save(tmp_path / "out", provenance={})
    again = load_model(tmp_path / "out")
    assert saved == tmp_path / "out/point_cloud/iteration_14000/point_cloud.ply"
    assert saved.with_name("deformation.pth").read_bytes() == (folder / "point_cloud/iteration_14000/deformation.pth").read_bytes()
    assert not saved.with_name("deformation_table.pth").exists()  # by row; the project makes it anew where it is absent
    assert all(torch.equal(base.parameters()[name], tensor) for name, tensor in again.parameters().items())
    assert torch.equal(base.gaussians(moving.at(0.6)).sh, again.gaussians(moving.at(0.6)).sh)


def test_a_folder_without_cameras_adapts_on_an_orbit_at_all_times(tmp_path):
    (moving.write_hexplane(tmp_path / "m") / "cameras.json").unlink()  # which the project never writes
    adapted = wrap_model(tmp_path / "m").adapt(1 / 32, recipe="instant", extra_views=3)
    assert adapted.report.views.endswith("(the checkpoint came without cameras), 3 of them without a time of their own, spread over 0..1")


def test_the_coarse_stage_is_plain_splats(tmp_path):
    ply = tmp_path / "m/point_cloud/coarse_iteration_3000/point_cloud.ply"
    ply.parent.mkdir(parents=True)
    tiny.ply(ply)
    model = load_model(ply)
    assert (model.family, model.folder) == ("3dgs", tmp_path / "m")
    assert any("nothing moves yet" in note for note in model.notes)


def test_an_iteration_without_its_network_is_passed_over(tmp_path):
    folder = moving.write_hexplane(tmp_path / "m")
    newer = folder / "point_cloud/iteration_20000/point_cloud.ply"
    newer.parent.mkdir()
    tiny.ply(newer, degree=3)
    model = load_model(folder)
    assert model.source.parent.name == "iteration_14000"
    assert any("lacks the network" in note for note in model.notes)


@pytest.mark.parametrize(
    ("options", "change", "sentence"),
    [
        ("empty_voxel=True", dict, "trained with empty_voxel, which is not read"),
        ("grid_pe=2", dict, "trained with grid_pe"),
        ("", lambda s: moving.without(s, "deformation_net.grid.aabb"), r"lacks grid\.aabb"),
        ("", lambda s: moving.without(s, "deformation_net.grid.grids.1.4"), r"lacks grid\.grids\.1\.4"),
        ("", lambda s: {**s, "deformation_net.grid.grids.0.2": torch.zeros(1, 3, 5, 8)}, r"not \[1, 8, -1, -1\]"),
        (ALL_ON, lambda s: {**s, "deformation_net.shs_deform.3.weight": torch.zeros(12, 32)}, r"not \[48, 32\]"),
        ("no_grid=True", dict, r"feature_out\.0\.weight has the shape \[32, 16\], not \[32, 4\]"),
    ],
)
def test_networks_that_do_not_fit_are_refused_in_one_sentence(tmp_path, options, change, sentence):
    folder = moving.write_hexplane(tmp_path / "m", options, change(moving.hexplane_state()))
    with pytest.raises(CheckpointError, match=sentence):
        load_model(folder)


def test_color_changes_need_splats_of_degree_3(tmp_path):
    folder: Path = moving.write_hexplane(tmp_path / "m", ALL_ON, degree=1)
    with pytest.raises(CheckpointError, match="SH degree 3, but its PLY has 1"):
        load_model(folder)
