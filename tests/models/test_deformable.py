"""Deformable 3D Gaussians: what it reads, shows, adapts and writes."""

import moving
import numpy as np
import pytest
import tiny
import torch
from oracle import rotation_one
from zip_files import archive

from mipmap_plugin.errors import CheckpointError, SettingsError
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.state_dict import read_state_dict
from mipmap_plugin.models import detect, load_model
from mipmap_plugin.models.moving.deformable import move_along_screw
from mipmap_plugin.wrap import wrap_model

VARIANTS = [(timenet, six_dof) for timenet in (False, True) for six_dof in (False, True)]


def wave(values, octaves):
    """x, sin x, cos x, sin 2x, cos 2x, ..."""
    return np.concatenate([values] + [f(2.0**k * values) for k in range(octaves) for f in (np.sin, np.cos)])


def cross_matrix(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def screw(turn, angle, shift, point):
    """Where the published exponential map carries a point."""
    k = cross_matrix(turn)
    turned = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
    return turned @ point + (angle * np.eye(3) + (1 - np.cos(angle)) * k + (angle - np.sin(angle)) * k @ k) @ shift


def oracle(state, xyz, q, log_scale, time):
    """One splat in float64: its mean and covariance at a time."""
    w = {name: tensor.double().numpy() for name, tensor in state.items()}
    layer = lambda name, h: w[f"{name}.weight"] @ h + w[f"{name}.bias"]  # noqa: E731
    moment = wave(np.array([time]), 10)
    if "timenet.0.weight" in w:
        moment = layer("timenet.2", np.maximum(layer("timenet.0", wave(np.array([time]), 6)), 0))
    inputs = np.concatenate([wave(xyz, 10), moment])
    h = inputs
    for i in range(8):
        h = np.maximum(layer(f"linear.{i}", h), 0)
        h = np.concatenate([inputs, h]) if i == 4 else h
    if "branch_w.weight" in w:
        turn, shift = layer("branch_w", h), layer("branch_v", h)
        theta = np.linalg.norm(turn)
        mean = screw(turn / theta + 1e-5, theta, shift / theta + 1e-5, xyz)
    else:
        mean = xyz + layer("gaussian_warp", h)
    scale = np.exp(log_scale) + layer("gaussian_scaling", h)
    frame = rotation_one(torch.from_numpy(q / np.linalg.norm(q) + layer("gaussian_rotation", h))).numpy()  # of a quaternion of any length
    return mean, frame @ np.diag(scale**2) @ frame.T


@pytest.mark.parametrize(("timenet", "six_dof"), VARIANTS)
def test_every_variant_agrees_with_an_independent_evaluation(tmp_path, timenet, six_dof):
    state = moving.deform_state(timenet, six_dof)
    model = load_model(moving.write_deformable(tmp_path / "m", state))
    raw = {name: tensor.double().numpy() for name, tensor in model.parameters().items()}
    for time in (0.0, 0.37, 1.0):
        splats = model.gaussians(moving.at(time))
        for row in range(0, 60, 7):
            mean, covariance = oracle(state, raw["means"][row], raw["quats"][row], raw["scales"][row], time)
            np.testing.assert_allclose(splats.means[row].numpy(), mean, atol=1e-5)
            np.testing.assert_allclose(splats.covariances[row].numpy(), covariance, atol=1e-5 * np.abs(covariance).max())
        assert torch.equal(splats.opacities, model.parameters()["opacities"].sigmoid())


def test_scales_that_turn_negative_show_what_the_kernel_squares(tmp_path):
    state = moving.deform_state()
    state["gaussian_scaling.bias"] -= 0.3  # longer than any splat
    model = load_model(moving.write_deformable(tmp_path / "m", state))
    raw = {name: tensor.double().numpy() for name, tensor in model.parameters().items()}
    splats = model.gaussians(moving.at(0.5))
    assert (raw["scales"] < np.log(0.2)).all() and (splats.scales > 0).all()
    _, covariance = oracle(state, raw["means"][3], raw["quats"][3], raw["scales"][3], 0.5)
    np.testing.assert_allclose(splats.covariances[3].numpy(), covariance, rtol=1e-4, atol=1e-6)


def test_a_screw_without_a_turn_is_a_shift_and_its_gradient_is_finite():
    points = torch.randn(5, 3, dtype=torch.float64, requires_grad=True)
    shifts = torch.randn(5, 3, dtype=torch.float64)
    moved = move_along_screw(points, torch.zeros(5, 3, dtype=torch.float64), shifts)
    torch.testing.assert_close(moved, points + shifts)
    (gradient,) = torch.autograd.grad(moved.sum(), points)
    torch.testing.assert_close(gradient, torch.ones_like(points))


@pytest.mark.parametrize("angle", [1e-12, 1e-4, 0.499, 0.501, 3.0, 40.0])
def test_screws_of_any_angle_follow_the_published_formula(angle):
    axis = np.array([0.48, -0.6, 0.64])
    shift, point = np.array([0.3, -0.2, 0.5]), np.array([1.0, 2.0, -1.0])
    expected = screw(axis + 1e-5, angle, shift / angle + 1e-5, point)
    moved = move_along_screw(*(torch.tensor(vector, dtype=torch.float64)[None] for vector in (point, angle * axis, shift)))
    np.testing.assert_allclose(moved[0].numpy(), expected, rtol=0, atol=1e-10)


def test_no_gradient_passes_through_the_network(tmp_path):
    student = load_model(moving.write_deformable(tmp_path / "m")).copy()
    student.gaussians(moving.at(0.5)).means.sum().backward()
    assert torch.equal(student.parameters()["means"].grad, torch.ones(60, 3))
    assert student.parameters()["scales"].grad is None


def test_a_camera_without_a_time_renders_time_0(tmp_path):
    model = load_model(moving.write_deformable(tmp_path / "m"))
    timeless, start, later = (model.gaussians(moving.at(time)).means for time in (None, 0.0, 1.0))
    assert torch.equal(timeless, start) and not torch.equal(start, later)
    assert any("without a time shows the moment 0" in note for note in model.notes)


# Saving


def test_what_is_saved_loads_again_and_is_laid_out_as_the_project_reads_it(tmp_path):
    folder = moving.write_deformable(tmp_path / "m", iteration=20_000)
    base = load_model(folder)
    saved = base.save(tmp_path / "out", provenance={"scale": 0.25})
    assert saved == tmp_path / "out/point_cloud/iteration_20000/point_cloud.ply"
    assert (tmp_path / "out/deform/iteration_20000/deform.pth").read_bytes() == (folder / "deform/iteration_20000/deform.pth").read_bytes()
    assert (tmp_path / "out/cfg_args").read_text() == (folder / "cfg_args").read_text()
    for again in (load_model(tmp_path / "out"), load_model(saved)):
        assert all(torch.equal(base.parameters()[name], tensor) for name, tensor in again.parameters().items())
        assert torch.equal(base.gaussians(moving.at(0.6)).covariances, again.gaussians(moving.at(0.6)).covariances)
    names = list(read_ply(saved).columns)  # the project takes f_rest, scale and rot in the order of the file, and asserts their number
    assert [name for name in names if name.startswith("f_rest_")] == [f"f_rest_{i}" for i in range(3 * (1 + 1) ** 2 - 3)]
    assert [name for name in names if name.startswith(("scale_", "rot"))] == [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def test_a_single_ply_cannot_hold_the_network(tmp_path):
    model = load_model(moving.write_deformable(tmp_path / "m"))
    with pytest.raises(SettingsError, match="leave out the ending, and a folder is written"):
        model.save(tmp_path / "out.ply", provenance={})


# Adapting


def test_an_adapted_model_keeps_its_rows_together_when_splats_are_dropped(tmp_path):
    wrapped = wrap_model(moving.write_deformable(tmp_path / "m"))
    adapted = wrapped.adapt(1 / 4, steps=4, extra_views=0, prune_every=2, min_opacity=0.4, returns="last")
    assert 0 < len(adapted.model.gaussians(tiny.cameras()[0])) < 60


# What cannot be read


def test_splats_without_the_network_of_their_iteration_are_passed_over(tmp_path):
    folder = moving.write_deformable(tmp_path / "m", iteration=7000)
    newer = folder / "point_cloud/iteration_30000/point_cloud.ply"
    newer.parent.mkdir()
    tiny.ply(newer)
    checkpoint = detect(folder)
    assert (checkpoint.family, checkpoint.iteration) == ("deformable", 7000)
    assert "lacks the network that moves its splats" in checkpoint.notes[0]
    with pytest.raises(CheckpointError, match=r"deform/iteration_30000/deform\.pth"):
        load_model(folder, iteration=30_000)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda s: moving.without(s, "linear.3.bias"), "lacks linear.3.bias"),
        (lambda s: moving.without(s, "gaussian_warp.weight"), "lacks gaussian_warp.weight"),
        (lambda s: {**s, "linear.5.weight": torch.zeros(256, 256)}, r"linear.5.weight has the shape \[256, 256\], not \[256, 340\]"),
        (lambda s: {**s, "linear.0.weight": torch.zeros(256)}, r"not \[-1, -1\]"),
        (lambda s: {**s, "gaussian_rotation.bias": torch.full((4,), torch.nan)}, "not finite in gaussian_rotation.bias"),
        (lambda s: {"state": s}, "other things than the weights"),
    ],
)
def test_networks_that_do_not_fit_are_refused_in_one_sentence(tmp_path, change, sentence):
    folder = moving.write_deformable(tmp_path / "m", change(moving.deform_state()))
    with pytest.raises(CheckpointError, match=sentence):
        load_model(folder)


def test_another_archive_in_its_place_is_refused(tmp_path):
    network = moving.write_deformable(tmp_path / "m") / "deform/iteration_40000/deform.pth"
    archive(network, {"readme.txt": "not a network"})
    with pytest.raises(CheckpointError, match="damaged"):
        load_model(tmp_path / "m")


def test_the_published_recipe_clones_and_splits_before_the_splats_move(tmp_path):
    wrapped = wrap_model(moving.write_deformable(tmp_path / "m", moving.deform_state(width=64)))
    adapted = wrapped.adapt(1 / 4, recipe="paper", steps=3, prune_every=2, densify_gradient=1e-9)
    assert adapted.report.gaussians_after > 60
    assert all(bool(tensor.isfinite().all()) for tensor in adapted.model.parameters().values())


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("deform.pth", "its first layer takes 42 numbers, not 63 of the position and 21 of the time, so a changed copy"),  # of a 1-D code
        ("deform_v2.pth", r"it has no layers linear\.0, .*, but deformation_network, encoder, rot_shift, sca_shift, so a changed copy"),
    ],
)
def test_real_networks_of_a_changed_project_are_refused_with_what_is_different(shared_data, tmp_path, name, sentence):
    folder = moving.write_deformable(tmp_path / "m", read_state_dict(shared_data / "checkpoints/deform" / name))
    with pytest.raises(CheckpointError, match=sentence):
        load_model(folder)
