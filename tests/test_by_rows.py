"""Steps that the CPU backend takes itself, against autograd's gradients and the dense optimizer."""

import importlib.util
import math

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.optimization.by_rows import adam_step, moves_by_rows
from mipmap_plugin.adaptation.optimization.optimizer import make_optimizer
from mipmap_plugin.backends.base import AdamStep
from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.models.surfels import SurfelModel
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.recipes import recipe

pytestmark = pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="numba, the extra `cpu`, is not installed")
BACKEND, VIEWS = CpuBackend(), tiny.cameras(3)
SHOTS = [(view, Effects(1)) for view in VIEWS]


def student(count: int = 77, degree: int = 1) -> VanillaModel:
    """A count that is no multiple of 16, quaternions that are not of unit length, and one that is zero."""
    parameters = tiny.model(count, degree=degree).parameters()
    parameters["quats"] = parameters["quats"] * torch.linspace(0.1, 9.0, count)[:, None]
    parameters["quats"][3] = 0
    return VanillaModel(parameters).copy()


def loss(drawn) -> torch.Tensor:
    return sum((rendered.image - 0.4).square().mean() for rendered in drawn)


def dense_step(model, optimizer, shots=SHOTS):
    loss(BACKEND.render_views(model.gaussians(), shots)).backward()
    optimizer.step()
    optimizer.zero_grad()


def step_by_rows(model, optimizer, shots=SHOTS):
    leaves = model.gaussians().detach()
    leaves.means.requires_grad_()
    drawn, later = BACKEND.render_to_step(leaves, shots)
    loss(drawn).backward()
    assert leaves.means.grad is None
    later.step(adam_step(optimizer))


def after(steps, **options) -> dict[str, torch.Tensor]:
    """The parameters and moments after some steps."""
    model = student(**options)
    optimizer = make_optimizer(model, recipe("default", 1 / 4), pixel=0.1)
    for step in steps:
        step(model, optimizer)
    parameters = model.parameters()
    moments = {f"{name} {key}": value for name, tensor in parameters.items() for key, value in optimizer.state_of(tensor).items()}
    return {name: tensor.detach() for name, tensor in parameters.items()} | moments


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_steps_by_rows_are_those_of_dense_gradients(degree):
    rows, dense = (after([step] * 3, degree=degree) for step in (step_by_rows, dense_step))
    for name in dense:
        torch.testing.assert_close(rows[name], dense[name], atol=2e-5, rtol=2e-3, msg=lambda text, name=name: f"{name}: {text}")


def test_both_kinds_of_steps_go_on_from_one_another():
    mixed = after([dense_step, step_by_rows, dense_step, step_by_rows])
    for name, tensor in after([dense_step] * 4).items():
        torch.testing.assert_close(mixed[name], tensor, atol=2e-5, rtol=2e-3, msg=lambda text, name=name: f"{name}: {text}")


def test_a_step_has_the_same_bytes_on_any_number_of_threads(monkeypatch):
    from mipmap_plugin.backends.cpu_kernels import descending, threads

    monkeypatch.setattr(threads, "MIN_WORK", 0)
    monkeypatch.setattr(descending, "ROWS", 32)
    results, before = [], torch.get_num_threads()
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            results.append(after([step_by_rows] * 2))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(result[name], tensor) for result in results[1:] for name, tensor in results[0].items())


def test_the_kernel_of_a_step_against_float64():
    """One splat parameter, several steps: the formulas of Kingma and Ba."""
    model = student(16)
    optimizer = make_optimizer(model, recipe("default", 1 / 4), pixel=0.1)
    opacity, mean, square = model.parameters()["opacities"].detach().double(), torch.zeros(16).double(), torch.zeros(16).double()
    (beta1, beta2), rate = optimizer.betas, recipe("default", 1 / 4).rates.opacities
    for count in (1, 2, 3):
        raw = student(16)
        raw.replace_parameters({name: tensor.detach().clone() for name, tensor in model.parameters().items()})
        loss(ReferenceBackend().render(raw.gaussians(), *shot) for shot in SHOTS).backward()
        gradient = raw.parameters()["opacities"].grad.double()
        mean, square = beta1 * mean + (1 - beta1) * gradient, beta2 * square + (1 - beta2) * gradient**2
        opacity = opacity - rate * mean / (1 - beta1**count) / ((square / (1 - beta2**count)).sqrt() + 1e-15)
        step_by_rows(model, optimizer)
    torch.testing.assert_close(model.parameters()["opacities"].detach().double(), opacity, atol=2e-4, rtol=1e-3)


def test_only_plain_splats_that_all_move_go_by_rows():
    model, surfels = student(), SurfelModel(tiny.model().parameters()).copy()
    assert moves_by_rows(model) and not moves_by_rows(surfels)
    model.parameters()["shN"].requires_grad_(False)
    assert not moves_by_rows(model)
    apart = student()
    apart.replace_parameters({name: tensor.detach().clone() for name, tensor in apart.parameters().items()})
    assert not moves_by_rows(apart)


def test_a_family_that_activates_otherwise_is_not_plain():
    class Doubled(VanillaModel):
        def _activated(self, sh):
            return super()._activated(2 * sh)

    assert student().traits.plain and not Doubled(tiny.model().parameters()).traits.plain


def test_a_step_before_the_gradients_are_known_is_refused():
    leaves = student().gaussians().detach()
    leaves.means.requires_grad_()
    _, later = BACKEND.render_to_step(leaves, SHOTS)
    with pytest.raises(RuntimeError, match="backward"):
        later.step(AdamStep({}, {}, {}, {}, (0.9, 0.999), math.nan, 0.0))
