"""Any backend against the float64 reference, case by case."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import torch
from torch import Tensor

from mipmap_plugin.backends.base import Backend, Needs, Rendered
from mipmap_plugin.backends.conformance.cases import CASES, Builder, HardCase
from mipmap_plugin.backends.conformance.tolerance import differing_gradients, differing_images, not_finite, tolerance_for
from mipmap_plugin.backends.reference import ReferenceBackend, finite_rows
from mipmap_plugin.errors import ShapeError
from mipmap_plugin.gaussians import Gaussians


@dataclass(frozen=True)
class Outcome:
    """How one backend did on one case."""

    case: str
    max_error: float  # the largest difference in image or alpha; NaN where there is none to compare
    finite: bool  # image, alpha and all gradients
    passed: bool  # also where the case was skipped
    message: str  # what is wrong, or why the case was skipped; empty when all is well
    skipped: bool = False


@dataclass(frozen=True, eq=False)
class Answer:
    """An image and the gradients of one fixed loss over it, in float64 on the CPU."""

    image: Tensor  # [H, W, 3]
    alpha: Tensor  # [H, W, 1]
    gradients: dict[str, Tensor]  # by field of Gaussians; none when the backend has no gradients


def check_backend(
    backend: Backend, cases: Mapping[str, Builder] | None = None, *, dtype: torch.dtype = torch.float32, device: str = "cpu"
) -> list[Outcome]:
    """Render and differentiate every case, by default all of `CASES`, on `device`.

    What `backend` raises becomes a failed outcome. Raises SettingsError for a dtype without tolerances.
    """
    tolerance_for(dtype)
    outcomes = []
    for name, build in (CASES if cases is None else cases).items():
        try:
            outcomes.append(check_case(backend, name, build, dtype=dtype, device=device))
        except Exception as error:  # whatever a stranger's backend raises is the finding
            outcomes.append(Outcome(name, float("nan"), False, False, f"{type(error).__name__}: {error}"))
    return outcomes


def check_case(backend: Backend, name: str, build: Builder, *, dtype: torch.dtype = torch.float32, device: str = "cpu") -> Outcome:
    """One case. Raises what `backend` raises, ShapeError for an image that is not what was asked for, SettingsError as `check_backend`."""
    case = build()
    case = case._replace(gaussians=case.gaussians.to(device, dtype))
    needs = Needs.of(case.gaussians, case.effects, gradients=True)
    reasons = backend.lacking(replace(needs, gradients=False))
    if reasons:
        return Outcome(name, float("nan"), True, True, "; ".join(reasons), skipped=True)
    actual = draw(backend, case, differentiate=not backend.lacking(needs))
    return compare(name, actual, expectation(build, dtype), dtype)


def draw(backend: Backend, case: HardCase, *, differentiate: bool = True) -> Answer:
    """The image of `case`, and the gradients of its sum under fixed random weights of both signs."""
    leaves = {f.name: getattr(case.gaussians, f.name) for f in fields(Gaussians)}
    leaves = {name: leaf.detach().clone().requires_grad_(differentiate) for name, leaf in leaves.items() if leaf is not None}
    rendered = backend.render(Gaussians(**leaves), case.camera, case.effects)
    _as_asked(rendered, case)
    image, alpha = rendered.image, rendered.alpha[..., None]
    gradients = {}
    if differentiate:
        weights = torch.rand(*case.camera.size, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 2 - 1
        loss = (torch.cat([image, alpha], -1) * weights.to(image)).sum()
        pulls = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True, materialize_grads=True)
        gradients = {name: _plain(pull) for name, pull in zip(leaves, pulls, strict=True)}
    if "covariances" in gradients:  # a covariance is symmetric: only that part of its gradient has a meaning
        gradients["covariances"] = (gradients["covariances"] + gradients["covariances"].mT) / 2
    return Answer(_plain(image), _plain(alpha), gradients)


@lru_cache(maxsize=256)
def expectation(build: Builder, dtype: torch.dtype) -> Answer:
    """What the float64 reference makes of a case's numbers after their rounding to `dtype`.

    A row that is not finite must be as if it were not there: it is left out, and its gradient is 0.
    """
    case = build()
    rounded = case.gaussians.to(dtype=dtype).to(dtype=torch.float64)
    sound = finite_rows(rounded)
    answer = draw(ReferenceBackend(), case._replace(gaussians=rounded[sound]))
    everywhere = {name: part.new_zeros(len(rounded), *part.shape[1:]).index_put((sound,), part) for name, part in answer.gradients.items()}
    return replace(answer, gradients=everywhere)


def compare(name: str, actual: Answer, expected: Answer, dtype: torch.dtype) -> Outcome:
    """The outcome of case `name`, with every sentence that there is to say about it."""
    tolerance = tolerance_for(dtype)
    images = [("image", actual.image, expected.image), ("alpha", actual.alpha, expected.alpha)]
    gradients = [(field, actual.gradients[field], expected.gradients[field]) for field in actual.gradients]
    error = max(float((a - e).abs().max()) for _, a, e in images)
    infinite = [not_finite(what, a) for what, a, _ in images] + [not_finite(f"gradient of {what}", a) for what, a, _ in gradients]
    finite = not any(infinite)
    differing = [differing_images(*part, tolerance) for part in images] + [differing_gradients(*part, tolerance) for part in gradients]
    wrong = [sentence for sentences in (differing if finite else infinite) for sentence in sentences]
    return Outcome(name, error, finite, not wrong, "; ".join(wrong))


def _as_asked(rendered: Rendered, case: HardCase) -> None:
    means = case.gaussians.means
    for what, tensor, shape in (("image", rendered.image, (*case.camera.size, 3)), ("alpha", rendered.alpha, case.camera.size)):
        got, asked = ((list(size), t.dtype, t.device.type) for size, t in ((tensor.shape, tensor), (shape, means)))
        if got != asked:
            raise ShapeError(f"{what}: {got} where {asked} was asked for")


def _plain(tensor: Tensor) -> Tensor:
    return tensor.detach().to("cpu", torch.float64)
