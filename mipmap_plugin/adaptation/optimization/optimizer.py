"""Adam over a model's parameters by name, and the surgery that keeps moments and rows together."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.adam import Adam
from mipmap_plugin.adaptation.optimization.snapshot import Snapshot
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.models.base import CARRIED, SplatModel

# INRIA's: gradients of single splats are so small that Adam's usual 1e-8 would damp them.
ADAM_EPS = 1e-15


def make_optimizer(model: SplatModel, config: AdaptConfig, pixel: float) -> Adam:
    """One group per parameter that moves; that of means is in pixels of `pixel` world units."""
    rates = {**config.rates.model_dump(), CARRIED: 0.0}
    rates["means"] *= pixel
    groups = [{"params": [tensor], "lr": rates[name], "base_lr": rates[name], "name": name} for name, tensor in model.parameters().items()]
    if shared := list(model.shared_parameters().values()):
        groups.append({"params": shared, "lr": rates["networks"], "base_lr": rates["networks"], "name": "networks"})
    return Adam(groups, betas=config.betas, eps=ADAM_EPS)


def set_rates(optimizer: Adam, config: AdaptConfig, progress: float, boldness: float, still: Collection[str] = ()) -> None:
    """Each rate at `progress` (0..1) of its fall, which is half a cosine (Loshchilov and Hutter 2017, SGDR, equation 5), times `boldness`.

    The groups in `still` stand.
    """
    share = boldness * (config.decay + (1 - config.decay) * (1 + math.cos(math.pi * progress)) / 2)
    for group in optimizer.param_groups:
        group["lr"] = 0.0 if group["name"] in still else group["base_lr"] * share


def take_back(model: SplatModel, optimizer: Adam, snapshot: Snapshot) -> None:
    """Let the model hold the snapshot, in its own leaves where it has as many rows; Adam begins anew."""
    if len(model.parameters()["means"]) != len(snapshot.rows["means"]):
        put_back(model, optimizer, snapshot.rows)
    snapshot.put_into(model)
    optimizer.state.clear()


def put_back(model: SplatModel, optimizer: Adam, before: Mapping[str, Tensor]) -> None:
    """Let the model hold the parameters that it had `before`; for them Adam begins anew.

    Moments at 0 whose steps went on being counted would make the first step three times too long.
    """
    change_rows(model, optimizer, lambda name, _: before[name], torch.zeros_like)
    for tensor in model.parameters().values():
        optimizer.state.pop(tensor, None)


def change_rows(
    model: SplatModel, optimizer: Adam, parameter: Callable[[str, Tensor], Tensor], moment: Callable[[Tensor], Tensor]
) -> None:
    """Replace every parameter by `parameter(name, old)` and its moments by `moment(old)`, in model and optimizer alike."""
    fresh, moves = {}, {}
    names = model.parameters().keys()
    for group in (group for group in optimizer.param_groups if group["name"] in names):
        old = group["params"][0]
        new = parameter(group["name"], old.detach()).clone().requires_grad_()
        moves[group["name"]] = old.requires_grad
        state = optimizer.state.pop(old, {})
        optimizer.state[new] = {k: moment(v) if torch.is_tensor(v) and v.shape == old.shape else v for k, v in state.items()}
        group["params"] = [new]
        fresh[group["name"]] = new
    model.replace_parameters(fresh)
    for name, tensor in fresh.items():
        tensor.requires_grad_(moves[name])
