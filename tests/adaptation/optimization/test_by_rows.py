"""Steps that the CPU backend takes itself, against autograd's gradients and the dense optimizer."""

import importlib.util

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.optimization.by_rows import ByRows
from mipmap_plugin.adaptation.optimization.optimizer import make_optimizer
from mipmap_plugin.adaptation.renderers import SteppingRenderer
from mipmap_plugin.backends.base import AdamStep
from mipmap_plugin.backends.cpu import CpuBackend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.models.surfels import SurfelModel
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.process import threads
from mipmap_plugin.process.threads import side_by_side
from mipmap_plugin.recipes import recipe
from mipmap_plugin.splatting.bands import neighbors
from mipmap_plugin.splatting.viewers import BUILT_IN

pytestmark = pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="numba, the extra `cpu`, is not installed")
BACKEND, VIEWS = CpuBackend(), tiny.cameras(3)
SHOTS = [(view, Effects(1)) for view in VIEWS]


known: dict[VanillaModel, ByRows] = {}


def student(count: int = 77, degree: int = 1) -> VanillaModel:
    """A count that is no multiple of 16, quaternions that are not of unit length, and one that is zero."""
    parameters = tiny.model(count, degree=degree).parameters()
    parameters["quats"] = parameters["quats"] * torch.linspace(0.1, 9.0, count)[:, None]
    parameters["quats"][3] = 0
    return VanillaModel(parameters).copy()


def loss(drawn) -> torch.Tensor:
    return sum((rendered.image - 0.4).square().mean() for rendered in drawn)


def draw(rows, shots=SHOTS) -> list[torch.Tensor]:
    return [rows.stepper.render(number, *shot).image for number, shot in enumerate(shots)]


def differentiate(rows, shots=SHOTS) -> None:
    """Hand the gradients of `loss` to the stepper."""
    for number, image in enumerate(draw(rows, shots)):
        rows.stepper.differentiate(number, 2 * (image - 0.4) / image.numel())


def dense_step(model, optimizer, shots=SHOTS):
    loss(BACKEND.render_views(model.gaussians(), shots)).backward()
    optimizer.step()
    optimizer.zero_grad()


def of(model, previous=None) -> ByRows | None:
    return ByRows.of(model, SteppingRenderer(BACKEND.stepper, [Effects(1)]), previous)


def optimizer_of(model, **settings):
    return make_optimizer(model, recipe("default", 1 / 4, **settings), pixel=0.1)


def stepped(model, limits=None) -> ByRows:
    """The rows of a model after a step."""
    rows = of(model)
    differentiate(rows)
    rows.step(optimizer_of(model), limits)
    return rows


def step_by_rows(model, optimizer, shots=SHOTS):
    rows = of(model, known.get(model))
    known[model] = rows
    differentiate(rows, shots)
    assert all(tensor.grad is None for tensor in model.parameters().values())
    rows.step(optimizer)


def after(steps, **options) -> dict[str, torch.Tensor]:
    """The parameters and moments after some steps."""
    model = student(**options)
    optimizer = optimizer_of(model)
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


def test_a_step_tells_the_gradient_of_the_means_by_which_splats_grow():
    model, told = student(), torch.full((77, 3), torch.nan)
    rows = of(model)
    differentiate(rows)
    rows.step(optimizer_of(model), means_gradient=told)
    dense = student()
    loss(BACKEND.render_views(dense.gaussians(), SHOTS)).backward()
    torch.testing.assert_close(told, dense.parameters()["means"].grad, atol=1e-7, rtol=1e-4)


def test_a_step_has_the_same_bytes_on_any_number_of_threads(monkeypatch):
    from mipmap_plugin.backends.cpu_kernels import descending, threads

    monkeypatch.setattr(threads, "MIN_WORK", 0)
    monkeypatch.setattr(threads, "LEAST_ROWS", 16)
    monkeypatch.setattr(descending, "ROWS", 32)
    results, before = [], torch.get_num_threads()
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            results.append(after([step_by_rows] * 2))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(result[name], tensor) for result in results[1:] for name, tensor in results[0].items())


def test_views_of_a_step_may_be_differentiated_in_any_order_and_thread():
    models = [student(), student()]
    for model, order in zip(models, (range(3), (2, 0, 1)), strict=True):
        rows = of(model)
        images = draw(rows)

        def one(number, rows=rows, images=images):
            rows.stepper.differentiate(number, images[number])

        list(side_by_side(one, order, 3))
        rows.step(optimizer_of(model))
    assert all(torch.equal(one, other) for one, other in zip(*(model.parameters().values() for model in models), strict=True))


@pytest.mark.parametrize(("count", "calls"), [(1, [1, 1, 1]), (2, [3]), (3, [3])])
def test_threads_project_all_views_of_a_step_together(count, calls, monkeypatch):
    """By rows, whose thread moves them too."""
    from mipmap_plugin.backends.cpu_kernels import drawing

    counts, project = [], drawing.project
    monkeypatch.setattr(drawing, "project", lambda splats, shots, **options: counts.append(len(shots)) or project(splats, shots, **options))
    images = []

    def compare(_, xs):
        images.extend(xs)
        return [(torch.zeros_like(x), torch.zeros(())) for x in xs]

    rows = of(student())
    with threads.limited(count, shared=True):
        rows.differentiate(VIEWS, 0, compare)
    assert counts == calls
    assert sorted(float(image.sum()) for image in images) == sorted(float(image.sum()) for image in draw(rows))


def test_a_view_that_was_projected_before_a_step_is_projected_again():
    model = student()
    rows = of(model)
    rows.stepper.prepare(SHOTS)
    rows.stepper.differentiate(0, torch.ones_like(rows.stepper.render(0, *SHOTS[0]).image))
    rows.step(optimizer_of(model))
    assert all(map(torch.equal, draw(rows), draw(of(model))))


@pytest.mark.parametrize("nesterov", [False, True])
def test_the_kernel_of_a_step_against_float64(nesterov):
    """One splat parameter, several steps: the formulas of Kingma and Ba, and Nesterov's momentum."""
    model = student(16)
    optimizer = optimizer_of(model, nesterov=nesterov)
    opacity, mean, square = model.parameters()["opacities"].detach().double(), torch.zeros(16).double(), torch.zeros(16).double()
    (beta1, beta2), rate = optimizer.betas, recipe("default", 1 / 4).rates.opacities
    for count in (1, 2, 3):
        raw = student(16)
        raw.replace_parameters({name: tensor.detach().clone() for name, tensor in model.parameters().items()})
        loss(ReferenceBackend().render(raw.gaussians(), *shot) for shot in SHOTS).backward()
        gradient = raw.parameters()["opacities"].grad.double()
        mean, square = beta1 * mean + (1 - beta1) * gradient, beta2 * square + (1 - beta2) * gradient**2
        ahead = beta1 * mean + (1 - beta1) * gradient if nesterov else mean
        opacity = opacity - rate * ahead / (1 - beta1**count) / ((square / (1 - beta2**count)).sqrt() + 1e-15)
        step_by_rows(model, optimizer)
    torch.testing.assert_close(model.parameters()["opacities"].detach().double(), opacity, atol=2e-4, rtol=1e-3)


@pytest.mark.parametrize("size", [0.0, 1e-38, 1e-29, 1e-22, 1e-18, 1e-15, 1e-12])
def test_quaternions_of_any_length_stay_finite(size):
    """The gradients of short ones are large, and their squares larger: those of the shortest are treated as zero."""
    model = student()
    with torch.no_grad():
        model.parameters()["quats"][::2] *= size
    optimizer = optimizer_of(model)
    for _ in range(3):
        step_by_rows(model, optimizer)
    assert all(raw.isfinite().all() for raw in model.parameters().values())


@pytest.mark.parametrize("limits", [None, (-0.1, 0.1)])
def test_what_is_drawn_after_a_step_are_the_moved_parameters_with_colors_within_limits(limits):
    model = student()
    rows = stepped(model, limits)
    assert of(model, rows) is rows
    assert (model.parameters()["sh0"].abs().max().item() == pytest.approx(0.1)) == bool(limits)
    with torch.no_grad():
        for image, expected in zip(draw(rows), BACKEND.render_views(model.gaussians(), SHOTS), strict=True):
            torch.testing.assert_close(image, expected.image, atol=1e-5, rtol=1e-4)


def test_changed_parameters_are_activated_anew_to_the_same_bytes():
    model = student()
    rows = stepped(model)
    with torch.no_grad():
        model.parameters()["scales"].add_(0)
        again = of(model, rows)
        assert again is not rows
        assert torch.equal(draw(again)[0], draw(rows)[0])  # so a run can be resumed
    model.replace_parameters(neighbors({name: tensor.detach().clone() for name, tensor in model.parameters().items()}))
    assert of(model, again) not in (None, again)


def test_moments_that_an_optimizer_has_forgotten_start_anew():
    model = student()
    rows, optimizer = of(model), optimizer_of(model)
    for _ in range(2):
        optimizer.state.clear()
        differentiate(rows)
        rows.step(optimizer)
    assert {float(optimizer.state_of(tensor)["step"]) for tensor in model.parameters().values()} == {1.0}


def test_only_plain_splats_that_all_move_go_by_rows():
    model, surfels = student(), SurfelModel(tiny.model().parameters()).copy()
    assert of(model) is not None and of(surfels) is None and ByRows.of(model, None, None) is None
    model.parameters()["shN"].requires_grad_(False)
    assert of(model) is None
    apart = student()
    apart.replace_parameters({name: tensor.detach().clone(memory_format=torch.contiguous_format) for name, tensor in apart.parameters().items()})
    assert of(apart) is None


def test_packed_effects_do_not_go_by_rows():
    packed = next(viewer for viewer in BUILT_IN if viewer.settings.packing).effects(Effects(1))
    assert SteppingRenderer.of(BACKEND, [Effects(1), packed]) is None
    assert SteppingRenderer.of(ReferenceBackend(), [Effects(1)]) is None


def test_a_family_that_activates_otherwise_is_not_plain():
    class Doubled(VanillaModel):
        def _activated(self, sh):
            return super()._activated(2 * sh)

    assert student().traits.plain and not Doubled(tiny.model().parameters()).traits.plain


def test_a_step_before_the_gradients_are_known_is_refused():
    rows = of(student())
    draw(rows)
    with pytest.raises(RuntimeError, match="differentiate"):
        rows.stepper.step(AdamStep({}, {}, {}, {}, (0.9, 0.999), 1.0, 0.0))
