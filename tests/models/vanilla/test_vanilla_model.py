"""The model of plain 3DGS: activated as 3DGS does, frozen as a base, and checked."""

import numpy as np
import pytest
import torch
from ply_files import splat_columns, write
from vanilla_models import raw_model, same

from mipmap_plugin.errors import SettingsError, ShapeError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.columns import OPACITY_MARGIN
from mipmap_plugin.models.raw import MIN_SCALE
from mipmap_plugin.models.reading import load_vanilla
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.splatting.rotations import unit_quaternions


def test_base_is_frozen_and_a_copy_is_independent():
    base = raw_model()
    before = {name: tensor.clone() for name, tensor in base.parameters().items()}
    copy = base.copy()
    assert all(tensor.is_leaf and tensor.requires_grad for tensor in copy.parameters().values())
    copy.reshape(lambda _: (torch.ones(4, 3), torch.zeros(4)))
    copy.notes.append("changed")
    assert not any(tensor.requires_grad for tensor in base.parameters().values())
    assert all(torch.equal(tensor, before[name]) for name, tensor in base.parameters().items())
    assert base.notes == []


def test_gradients_reach_every_parameter():
    model = raw_model().copy()
    splats = model.gaussians()
    sum(getattr(splats, name).square().sum() + getattr(splats, name).sum() for name in ("means", "quats", "scales", "opacities", "sh")).backward()
    assert all(tensor.grad.isfinite().all() and tensor.grad.any() for tensor in model.parameters().values())


def test_quaternion_gradient_is_exact():
    torch.manual_seed(0)
    quats = (torch.randn(5, 4, dtype=torch.float64) * torch.tensor([[0.01], [1], [3], [20], [100]])).requires_grad_()
    assert torch.autograd.gradcheck(unit_quaternions, quats)


@pytest.mark.parametrize("size", [0.0, 1e-42, 1e-16, 1e-15, 0.003, 1.0, 1e30])
def test_quaternions_of_any_size_are_safe(size):
    quats = (size * torch.tensor([[0.0, 3.0, 0.0, 4.0]])).requires_grad_()
    unit = unit_quaternions(quats)
    unit.sum().backward()
    torch.testing.assert_close(unit.detach(), torch.tensor([[0.0, 0.6, 0.0, 0.8]] if size > 1e-16 else [[1.0, 0.0, 0.0, 0.0]]))
    assert quats.grad.isfinite().all()


def test_legal_extremes_activate_to_finite_values_and_gradients(tmp_path):
    columns = splat_columns(6, 0)
    columns["opacity"][:4] = [80, -80, np.inf, -np.inf]
    columns["scale_0"][4:] = [-np.inf, -90]
    model = load_vanilla(write(tmp_path / "a.ply", columns)).copy()
    assert len(model) == 6
    splats = model.gaussians()
    torch.testing.assert_close(splats.opacities[:4].detach(), torch.tensor([1.0, 0, 1, 0]))
    (splats.opacities.sum() + splats.scales.sum()).backward()
    assert all(tensor.grad is None or tensor.grad.isfinite().all() for tensor in model.parameters().values())


def test_from_gaussians_activates_to_the_same():
    splats = raw_model(50).gaussians()
    again = VanillaModel.from_gaussians(splats).gaussians()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(again, name), getattr(splats, name))


def test_from_gaussians_refuses_covariances():
    splats = raw_model(1).gaussians()
    with pytest.raises(SettingsError, match="covariances"):
        VanillaModel.from_gaussians(Gaussians(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh, torch.eye(3)[None]))


def test_reshape_keeps_leaves_and_stays_finite_at_the_ends():
    model = raw_model(3).copy()
    leaf = model.parameters()["scales"]
    model.reshape(lambda _: (torch.tensor([[0.0, 1.0, 2.0]] * 3), torch.tensor([0.0, 0.5, 1.0])))
    splats = model.gaussians()
    assert model.parameters()["scales"] is leaf
    assert leaf.isfinite().all() and model.parameters()["opacities"].isfinite().all()
    torch.testing.assert_close(splats.scales[0].detach(), torch.tensor([MIN_SCALE, 1.0, 2.0]))
    torch.testing.assert_close(splats.opacities.detach(), torch.tensor([OPACITY_MARGIN, 0.5, 1 - OPACITY_MARGIN]))
    with pytest.raises(ShapeError, match="scales: expected shape"):
        model.reshape(lambda _: (torch.ones(1, 3), torch.ones(3)))


def test_shapes_are_checked():
    raw = raw_model().parameters()
    for broken, sentence in {
        "quats": ({**raw, "quats": raw["quats"][:2]}, "quats: expected shape"),
        "shN": ({**raw, "shN": raw["shN"][:, :7]}, "7 coefficients fit no SH degree"),
        "missing": ({"means": raw["means"]}, "expected means, scales"),
        "array": ({**raw, "sh0": raw["sh0"].numpy()}, "sh0: expected a torch tensor, got ndarray"),
        "number": ({**raw, "means": torch.tensor(0.0)}, r"means: expected shape \[0, 3\], got \[\]"),
        "device": ({**raw, "sh0": raw["sh0"].to("meta")}, "sh0: it is on meta, but means are on cpu; move all to one device"),
    }.values():
        with pytest.raises(ShapeError, match=sentence):
            VanillaModel(broken)


def test_to_is_a_copy():
    model = raw_model().copy()
    moved = model.to("cpu")
    assert same(moved, model)
    assert all(tensor.requires_grad and tensor.is_leaf for tensor in moved.parameters().values())
    assert moved.parameters()["means"].data_ptr() != model.parameters()["means"].data_ptr()


def test_row_opacities():
    model = raw_model().copy()
    torch.testing.assert_close(model.row_opacities(), model.gaussians().opacities.detach())
    assert not model.row_opacities().requires_grad
