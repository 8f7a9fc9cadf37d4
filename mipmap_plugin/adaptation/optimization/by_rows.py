"""Steps that the backend takes itself, row by row, so that no gradient of all splats exists (`backends.base.Stepper`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.adam import Adam
from mipmap_plugin.adaptation.renderers import Comparison, SteppingRenderer
from mipmap_plugin.backends.base import AdamStep, Stepper
from mipmap_plugin.camera import Camera
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.splatting.bands import neighbors, one_tensor

SH = ("sh0", "shN")


@dataclass(eq=False)
class ByRows:
    """A model that a backend draws and moves, and what its parameters were after that."""

    draw: SteppingRenderer
    stepper: Stepper
    raw: Mapping[str, Tensor]  # `AdamStep.raw`
    parameters: Mapping[str, Tensor]
    versions: tuple[int, ...]  # torch counts the changes in place that it makes; those of kernels it does not see
    moments: _Moments | None = None

    @classmethod
    def of(cls, model: SplatModel, draw: SteppingRenderer | None, known: ByRows | None) -> ByRows | None:
        """`known` if it still holds, else a new one; None without `draw`, or if the model's parameters are not all those of 3DGS, and move."""
        if draw is None or not model.traits.plain:
            return None
        parameters = dict(model.parameters())
        if known is not None and known._holds_for(parameters):
            return known
        raw = _joined(parameters)
        if raw is None or not all(tensor.requires_grad for tensor in parameters.values()):
            return None
        return cls(draw, draw.stepper(raw), raw, parameters, _versions(parameters))

    def _holds_for(self, parameters: Mapping[str, Tensor]) -> bool:
        same = parameters.keys() == self.parameters.keys() and all(tensor is self.parameters[name] for name, tensor in parameters.items())
        return same and self.versions == _versions(parameters)

    def differentiate(self, cameras: Sequence[Camera], draw: int, compare: Comparison) -> list[Tensor]:
        """Draw the views of a step, whose first is the `draw`-th since the beginning, and compare their images; return the mean square errors."""
        return self.draw.differentiate(self.stepper, cameras, draw, compare)

    def step(self, optimizer: Adam, color_limits: tuple[float, float] | None = None, means_gradient: Tensor | None = None) -> None:
        """Move the parameters, once some views are differentiated. color_limits: as of `Task`; means_gradient: as of `AdamStep`."""
        if self.moments is None or not self.moments.are_of(optimizer):
            self.moments = _Moments.of(optimizer, self.parameters)
        self.stepper.step(replace(self.moments.next_step(optimizer, self.raw), means_gradient=means_gradient))
        if color_limits is not None:
            self.raw["sh"][:, 0].clamp_(*color_limits)
            self.versions = _versions(self.parameters)


def _versions(parameters: Mapping[str, Tensor]) -> tuple[int, ...]:
    return tuple(tensor._version for tensor in parameters.values())


@dataclass(eq=False)
class _Moments:
    """The moments of an optimizer as a stepper takes them: those of sh0 and shN lie in one tensor."""

    states: Mapping[Tensor, dict[str, Any]]  # of the optimizer, which makes new ones when it starts anew
    first: Mapping[str, Tensor]
    second: Mapping[str, Tensor]
    steps: int  # as counted in the states, which to read means to wait for a GPU

    @classmethod
    def of(cls, optimizer: Adam, parameters: Mapping[str, Tensor]) -> _Moments:
        states = {name: optimizer.state_of(tensor) for name, tensor in parameters.items()}
        first, second = (_joined_moments(states, name) for name in ("exp_avg", "exp_avg_sq"))
        steps = int(next(iter(states.values()))["step"])
        return cls({parameters[name]: state for name, state in states.items()}, first, second, steps)

    def are_of(self, optimizer: Adam) -> bool:
        """Whether the optimizer still has them."""
        return all(optimizer.state.get(tensor) is state for tensor, state in self.states.items())

    @torch.no_grad()
    def next_step(self, optimizer: Adam, raw: Mapping[str, Tensor]) -> AdamStep:
        """The optimizer's next step over the raw parameters of 3DGS."""
        torch._foreach_add_([state["step"] for state in self.states.values()], 1)
        self.steps += 1
        beta1, beta2 = optimizer.betas
        rates = {group["name"]: group["lr"] / (1 - beta1**self.steps) for group in optimizer.param_groups}
        correction = (1 - beta2**self.steps) ** -0.5
        return AdamStep(raw, self.first, self.second, rates, optimizer.betas, correction, optimizer.eps, optimizer.nesterov)


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
