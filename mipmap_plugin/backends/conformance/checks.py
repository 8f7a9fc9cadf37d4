"""Comparison of a backend with the float64 reference, case by case."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.backends.base import AdamStep, Backend, Needs, Rendered
from mipmap_plugin.backends.conformance.cases import CASES, Builder, HardCase
from mipmap_plugin.backends.conformance.tolerance import differing_gradients, differing_images, not_finite, tolerance_for
from mipmap_plugin.backends.reference import ReferenceBackend, finite_rows
from mipmap_plugin.errors import ShapeError, with_type
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.rotations import unit_quaternions

# The share of the cases that has to be run to tell whether a backend is right. With a single screen filter, degree 0 and no settings it is a sixth.
LEAST_RUN = 1 / 20

# What `AdamStep.means_gradient` is called in a sentence.
TOLD = "means, by which splats grow"


@dataclass(frozen=True)
class Outcome:
    """The result of one backend on one case."""

    case: str
    max_error: float  # the largest difference in image or alpha; NaN if nothing was rendered
    finite: bool  # whether image, alpha and all gradients are
    passed: bool  # also true if the case was skipped
    message: str  # what is wrong, or why the case was skipped; empty if nothing is wrong
    skipped: bool = False


@dataclass(frozen=True, eq=False)
class Answer:
    """An image, and the gradients of a fixed loss over it, in float64 on the CPU."""

    image: Tensor  # [H, W, 3]
    alpha: Tensor  # [H, W, 1]
    gradients: dict[str, Tensor]  # by field of Gaussians; empty if the backend has no gradients


def check_backend(
    backend: Backend, cases: Mapping[str, Builder] | None = None, *, dtype: torch.dtype = torch.float32, device: str = "cpu"
) -> list[Outcome]:
    """Render and differentiate every case, by default all of `CASES`, on `device`.

    Colors are of the highest degree of SH that the backend evaluates, except in cases about that degree; a case that it cannot draw for another
    reason is skipped (`summary` counts). Whatever `backend` raises becomes a failed outcome. Raises SettingsError for a dtype without tolerances.
    """
    tolerance_for(dtype)
    outcomes = []
    for name, build in (CASES if cases is None else cases).items():
        try:
            outcomes.append(check_case(backend, name, build, dtype=dtype, device=device))
        except Exception as error:  # whatever a third-party backend raises is the result
            outcomes.append(Outcome(name, float("nan"), False, False, with_type(error)))
    return outcomes


def check_case(backend: Backend, name: str, build: Builder, *, dtype: torch.dtype = torch.float32, device: str = "cpu") -> Outcome:
    """Check one case. Raises whatever `backend` raises, ShapeError for an image of the wrong shape, dtype or device, and SettingsError as
    `check_backend` does."""
    case, reasons = fitted(backend, build, dtype=dtype, device=device)
    if reasons:
        return Outcome(name, float("nan"), True, True, "; ".join(reasons), skipped=True)
    needs = Needs.of(case.gaussians, case.effects, gradients=True)
    actual = draw(backend, case, differentiate=not backend.lacking(needs))
    return compare(name, actual, expected_answer(build, dtype, case.effects.sh_degree), dtype)


def fitted(backend: Backend, build: Builder, *, dtype: torch.dtype, device: str) -> tuple[HardCase, list[str]]:
    """A case as the backend is to draw it, and the reasons why it cannot."""
    case = build()
    case = case._replace(gaussians=case.gaussians.to(device, dtype)) if case.about_degree else lowered(backend, case, dtype=dtype, device=device)
    return case, backend.lacking(Needs.of(case.gaussians, case.effects, gradients=False))


def lowered(backend: Backend, case: HardCase, *, dtype: torch.dtype, device: str) -> HardCase:
    """The case on `device` in `dtype`, its colors evaluated to the highest degree that the backend has, or to all if it lacks something else."""
    case = case._replace(gaussians=case.gaussians.to(device, dtype))
    for degree in range(case.effects.sh_degree, -1, -1):
        lower = case._replace(effects=replace(case.effects, sh_degree=degree))
        if not backend.lacking(Needs.of(lower.gaussians, lower.effects, gradients=False)):
            return lower
    return case


def summary(outcomes: Sequence[Outcome]) -> str:
    """How many cases were run, skipped and failed: "421 cases: 300 run, 121 skipped, 0 failed"."""
    skipped, failed = sum(each.skipped for each in outcomes), sum(not each.passed for each in outcomes)
    return f"{len(outcomes)} cases: {len(outcomes) - skipped} run, {skipped} skipped, {failed} failed"


def check_views(backend: Backend, build: Builder, *, dtype: torch.dtype = torch.float32, device: str = "cpu") -> Outcome:
    """Check that `render_views`, which few backends have, draws a case and another view of it as `render` does, and sums their gradients."""
    case = lowered(backend, build(), dtype=dtype, device=device)
    splats = case.gaussians
    shots = [(case.camera, case.effects), (case.camera.zoomed(0.5), case.effects)]
    answers = []
    for renders in (backend.render_views, lambda splats, shots: [backend.render(splats, *shot) for shot in shots]):  # type: ignore[attr-defined]
        leaves = {name: tensor.detach().clone().requires_grad_() for name, tensor in splats.tensors().items()}
        drawn = renders(Gaussians(**leaves), shots)
        images = torch.cat([rendered.image.flatten(0, 1) for rendered in drawn])
        alphas = torch.cat([rendered.alpha.flatten() for rendered in drawn])
        loss = images.square().sum() + alphas.square().sum()
        grads = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True, materialize_grads=True)
        answers.append(Answer(_plain(images)[None], _plain(alphas)[None, :, None], dict(zip(leaves, map(_plain, grads), strict=True))))
    together, alone = answers
    return compare("views", together, alone, dtype)


def check_steps(backend: Backend, build: Builder, *, dtype: torch.dtype = torch.float32, device: str = "cpu") -> Outcome:
    """Check that a `stepper`, which few backends have, draws a case as `render` does, and hands the right gradients to Adam."""
    case = lowered(backend, build(), dtype=dtype, device=device)
    g = case.gaussians
    raw = {"means": g.means, "quats": 2 * g.quats, "scales": g.scales.log(), "opacities": g.opacities.logit(), "sh": g.sh}
    actual, expected = _step_answer(backend, raw, case), _raw_answer(backend, raw, case)
    return compare("steps", actual, expected, dtype)


def _raw_answer(backend: Backend, raw: Mapping[str, Tensor], case: HardCase) -> Answer:
    """The gradients of raw parameters by autograd."""
    leaves = {name: tensor.detach().clone().requires_grad_() for name, tensor in raw.items()}
    activated = {"quats": unit_quaternions(leaves["quats"]), "scales": leaves["scales"].exp(), "opacities": leaves["opacities"].sigmoid()}
    rendered = backend.render(Gaussians(**{**leaves, **activated}), case.camera, case.effects)
    grads = dict(zip(leaves, map(_plain, torch.autograd.grad(_squares(rendered), list(leaves.values()))), strict=True))
    return Answer(_plain(rendered.image), _plain(rendered.alpha)[..., None], grads | {TOLD: grads["means"]})


def _step_answer(backend: Any, raw: Mapping[str, Tensor], case: HardCase) -> Answer:
    """The gradients that a first step of rate 0 shows: the first moments over 1 - beta1."""
    beta = 0.5
    own, first, second = ({name: make(tensor) for name, tensor in raw.items()} for make in (torch.clone, torch.zeros_like, torch.zeros_like))
    stepper = backend.stepper(own)
    rendered = stepper.render(0, case.camera, case.effects)
    stepper.differentiate(0, 2 * rendered.image, 2 * rendered.alpha)  # the gradients of `_squares`
    rates = dict.fromkeys(("means", "quats", "scales", "opacities", "sh0", "shN"), 0.0)
    told = torch.full_like(own["means"], math.nan)
    stepper.step(AdamStep(own, first, second, rates, betas=(beta, beta), correction=1.0, eps=1.0, means_gradient=told))
    grads = {name: _plain(each) / (1 - beta) for name, each in first.items()} | {TOLD: _plain(told)}
    return Answer(_plain(rendered.image), _plain(rendered.alpha)[..., None], grads)


def _squares(rendered: Rendered) -> Tensor:
    return rendered.image.square().sum() + rendered.alpha.square().sum()


def draw(backend: Backend, case: HardCase, *, differentiate: bool = True) -> Answer:
    """Render `case`, and differentiate the sum of the image under fixed random weights of both signs."""
    leaves = {name: tensor.detach().clone().requires_grad_(differentiate) for name, tensor in case.gaussians.tensors().items()}
    rendered = backend.render(Gaussians(**leaves), case.camera, case.effects)
    _check_rendered(rendered, case)
    image, alpha = rendered.image, rendered.alpha[..., None]
    gradients = {}
    if differentiate:
        weights = torch.rand(*case.camera.size, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 2 - 1
        loss = (torch.cat([image, alpha], -1) * weights.to(image)).sum()
        grads = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True, materialize_grads=True) if loss.requires_grad else ()
        grads = grads or tuple(map(torch.zeros_like, leaves.values()))  # of an image of nothing, which may come without
        gradients = {name: _plain(grad) for name, grad in zip(leaves, grads, strict=True)}
    if "covariances" in gradients:  # a covariance is symmetric: only the symmetric part of its gradient is meaningful
        gradients["covariances"] = (gradients["covariances"] + gradients["covariances"].mT) / 2
    return Answer(_plain(image), _plain(alpha), gradients)


@cache
def expected_answer(build: Builder, dtype: torch.dtype, sh_degree: int) -> Answer:
    """The answer of the float64 reference to a case whose numbers were rounded to `dtype`, with colors evaluated to `sh_degree`.

    A splat that is not finite must have no effect: it is left out, and its gradient is 0.
    """
    case = build()
    case = case._replace(effects=replace(case.effects, sh_degree=sh_degree))
    rounded = case.gaussians.to(dtype=dtype).to(dtype=torch.float64)
    finite = finite_rows(rounded)
    answer = draw(ReferenceBackend(), case._replace(gaussians=rounded[finite]))
    gradients = {name: part.new_zeros(len(rounded), *part.shape[1:]).index_put((finite,), part) for name, part in answer.gradients.items()}
    return replace(answer, gradients=gradients)


def compare(name: str, actual: Answer, expected: Answer, dtype: torch.dtype) -> Outcome:
    """The outcome of case `name`, with a sentence for each difference."""
    tolerance = tolerance_for(dtype)
    images = [("image", actual.image, expected.image), ("alpha", actual.alpha, expected.alpha)]
    gradients = [(field, actual.gradients[field], expected.gradients[field]) for field in actual.gradients]
    error = max(float((a - e).abs().max()) for _, a, e in images)
    infinite = [not_finite(what, a) for what, a, _ in images] + [not_finite(f"gradient of {what}", a) for what, a, _ in gradients]
    finite = not any(infinite)
    differing = [differing_images(*part, tolerance) for part in images] + [differing_gradients(*part, tolerance) for part in gradients]
    wrong = [sentence for sentences in (differing if finite else infinite) for sentence in sentences]
    return Outcome(name, error, finite, not wrong, "; ".join(wrong))


def _check_rendered(rendered: Rendered, case: HardCase) -> None:
    """Raise ShapeError if the shape, dtype or device of what was rendered is not that of the case."""
    means = case.gaussians.means
    for what, tensor, shape in (("image", rendered.image, (*case.camera.size, 3)), ("alpha", rendered.alpha, case.camera.size)):
        got, expected = ((list(size), t.dtype, t.device.type) for size, t in ((tensor.shape, tensor), (shape, means)))
        if got != expected:
            raise ShapeError(f"{what}: expected {expected}, got {got}")


def _plain(tensor: Tensor) -> Tensor:
    return tensor.detach().to("cpu", torch.float64)
