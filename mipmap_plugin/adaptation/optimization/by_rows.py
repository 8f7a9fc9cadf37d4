"""Steps that the backend takes itself, row by row, so that no gradient of all splats exists (`backends.base.Backend.render_to_step`)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.adam import Adam
from mipmap_plugin.backends.base import AdamStep
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.splatting.bands import neighbors, one_tensor

SH = ("sh0", "shN")


def moves_by_rows(model: SplatModel) -> bool:
    """Whether all parameters are those of 3DGS and move, with sh0 and shN in one tensor, as in any copy of a model."""
    parameters = model.parameters()
    return model.traits.plain and all(tensor.requires_grad for tensor in parameters.values()) and _joined(parameters) is not None


@torch.no_grad()
def adam_step(optimizer: Adam) -> AdamStep:
    """The optimizer's next step over a model that `moves_by_rows`."""
    tensors = {group["name"]: group["params"][0] for group in optimizer.param_groups}
    states = {name: optimizer.state_of(tensor) for name, tensor in tensors.items()}
    first, second = (_joined_moments(states, name) for name in ("exp_avg", "exp_avg_sq"))
    counts = [state["step"] for state in states.values()]
    torch._foreach_add_(counts, 1)
    count, (beta1, beta2) = int(counts[0]), optimizer.betas
    rates = {group["name"]: group["lr"] / (1 - beta1**count) for group in optimizer.param_groups}
    raw = _joined(tensors)
    assert raw is not None  # since the model `moves_by_rows`
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
