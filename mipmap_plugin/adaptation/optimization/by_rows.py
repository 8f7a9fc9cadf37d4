"""Steps that the backend takes itself, row by row, so that no gradient of all splats exists (`backends.base.Stepper`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.adam import Adam
from mipmap_plugin.adaptation.renderers import Comparison, SteppingRenderer
from mipmap_plugin.backends.base import AdamStep, Stepper
from mipmap_plugin.camera import Camera
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.splatting.bands import neighbors, one_tensor

SH = ("sh0", "shN")


@dataclass(frozen=True, eq=False)
class ByRows:
    """A model that a backend draws and moves, and what its parameters were after that."""

    draw: SteppingRenderer
    stepper: Stepper
    parameters: tuple[Tensor, ...]
    versions: tuple[int, ...]  # torch counts the changes in place that it makes; those of kernels it does not see

    @classmethod
    def of(cls, model: SplatModel, draw: SteppingRenderer | None, known: ByRows | None) -> ByRows | None:
        """`known` if it still holds, else a new one; None without `draw`, or if the model's parameters are not all those of 3DGS, and move."""
        if draw is None or not model.traits.plain:
            return None
        parameters = tuple(model.parameters().values())
        if known is not None and known._holds_for(parameters):
            return known
        joined = _joined(model.parameters())
        if joined is None or not all(tensor.requires_grad for tensor in parameters):
            return None
        return cls(draw, draw.stepper(joined), parameters, tuple(tensor._version for tensor in parameters))

    def _holds_for(self, parameters: tuple[Tensor, ...]) -> bool:
        same = len(parameters) == len(self.parameters) and all(one is other for one, other in zip(parameters, self.parameters, strict=True))
        return same and self.versions == tuple(tensor._version for tensor in parameters)

    def differentiate(self, number: int, camera: Camera, draw: int, compare: Comparison) -> Tensor:
        """Draw the view of that number in a step, the `draw`-th since the beginning, and compare its image; return the mean square error."""
        return self.draw.differentiate(self.stepper, number, camera, draw, compare)

    def step(self, optimizer: Adam) -> None:
        """Move the parameters, once some views are differentiated."""
        self.stepper.step(adam_step(optimizer))


@torch.no_grad()
def adam_step(optimizer: Adam) -> AdamStep:
    """The optimizer's next step over the parameters of 3DGS, of which sh0 and shN lie in one tensor."""
    tensors = {group["name"]: group["params"][0] for group in optimizer.param_groups}
    states = {name: optimizer.state_of(tensor) for name, tensor in tensors.items()}
    first, second = (_joined_moments(states, name) for name in ("exp_avg", "exp_avg_sq"))
    counts = [state["step"] for state in states.values()]
    torch._foreach_add_(counts, 1)
    count, (beta1, beta2) = int(counts[0]), optimizer.betas
    rates = {group["name"]: group["lr"] / (1 - beta1**count) for group in optimizer.param_groups}
    raw = _joined(tensors)
    assert raw is not None  # since `ByRows` has checked it
    return AdamStep(raw, first, second, rates, optimizer.betas, (1 - beta2**count) ** -0.5, optimizer.eps)


def _joined(parameters: Mapping[str, Tensor]) -> dict[str, Tensor] | None:
    """The parameters with sh in place of sh0 and shN; None if these are not neighbors in memory, or others are not contiguous."""
    sh = one_tensor(parameters["sh0"], parameters["shN"])
    others = {name: tensor.detach() for name, tensor in parameters.items() if name not in SH}
    return None if sh is None or not all(tensor.is_contiguous() for tensor in others.values()) else {**others, "sh": sh}


def _joined_moments(states: Mapping[str, dict[str, Tensor]], name: str) -> dict[str, Tensor]:
    """One of the moments of each parameter. Those of sh0 and shN are made neighbors, once."""
    moments = {parameter: state[name] for parameter, state in states.items()}
    joined = _joined(moments)
    if joined is None:
        moments = neighbors(moments)
        for parameter in SH:
            states[parameter][name] = moments[parameter]
        joined = _joined(moments)
    assert joined is not None
    return joined
