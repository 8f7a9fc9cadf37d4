"""Adam over a model's parameters by name, and changes of rows that keep parameters and moments together."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.adam import Adam
from mipmap_plugin.adaptation.optimization.snapshot import Snapshot
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.models import contract
from mipmap_plugin.models.base import CARRIED, SplatModel
from mipmap_plugin.process import pool
from mipmap_plugin.splatting.bands import lie_in_one_tensor, neighbors

# INRIA's value: gradients of single splats are so small that Adam's usual 1e-8 would damp them.
ADAM_EPS = 1e-15

# The rate of the SH bands above 0 rises from this fraction over so many steps: Adam's first steps are as long by chance as by what many views agree
# on, and most numbers of a splat are of these bands. Worth up to 3 dB to runs of 5 to 10 steps, nothing to long ones (docs/recipes_found.md).
FIRST_FRACTION, RISING_STEPS = 0.25, 16


def make_optimizer(model: SplatModel, config: AdaptConfig, pixel: float) -> Adam:
    """One group per parameter; the learning rate of the means is in pixels of `pixel` world units."""
    rates = {**config.rates.model_dump(), CARRIED: 0.0}
    rates["means"] *= pixel
    groups = [{"params": [tensor], "lr": rates[name], "base_lr": rates[name], "name": name} for name, tensor in model.parameters().items()]
    if shared := list(model.shared_parameters().values()):
        groups.append({"params": shared, "lr": rates["networks"], "base_lr": rates["networks"], "name": "networks"})
    return Adam(groups, betas=config.betas, eps=ADAM_EPS, nesterov=config.nesterov)


def set_rates(optimizer: Adam, config: AdaptConfig, step: int, progress: float, rate_factor: float, frozen: Collection[str] = ()) -> None:
    """Set all learning rates for `progress` (0..1): `decayed`, times `rate_factor`; in a run with a warm-up those of SH bands rise with `step`.

    The rates of the groups named in `frozen` are 0.
    """
    factor = rate_factor * decayed(config, progress)
    rising = FIRST_FRACTION + (1 - FIRST_FRACTION) * min(1.0, step / RISING_STEPS) if config.warm_up else 1.0
    for group in optimizer.param_groups:
        name = group["name"]
        group["lr"] = 0.0 if name in frozen else group["base_lr"] * factor * (rising if name == "shN" else 1.0)


def decayed(config: AdaptConfig, progress: float) -> float:
    """What is left of learning rates at `progress` (0..1): cosine decay (Loshchilov and Hutter 2017, SGDR, equation 5)."""
    return config.decay + (1 - config.decay) * (1 + math.cos(math.pi * progress)) / 2


def restore_snapshot(model: SplatModel, optimizer: Adam, snapshot: Snapshot) -> None:
    """Set the model to the snapshot, in its own leaves where it has as many rows, without the momentum of the steps since.

    The second moments stay, where rows are the same: without them Adam's first steps are longest, and may do harm again.
    """
    if len(model.parameters()["means"]) != len(snapshot.rows["means"]):
        restore_parameters(model, optimizer, snapshot.rows)
    snapshot.put_into(model)
    for state in optimizer.state.values():
        if state:
            state["exp_avg"].zero_()


def restore_parameters(model: SplatModel, optimizer: Adam, before: Mapping[str, Tensor]) -> None:
    """Set the model's parameters to those that it had `before`, and reset Adam's state of them.

    If only the moments were reset and not the step count, the first step would be three times too long.
    """
    change_rows(model, optimizer, lambda name, _: before[name].clone(), torch.zeros_like)
    for tensor in model.parameters().values():
        optimizer.state.pop(tensor, None)


def change_rows(model: SplatModel, optimizer: Adam, parameter: Callable[[str, Tensor], Tensor], moment: Callable[[Tensor], Tensor]) -> None:
    """Replace every parameter by `parameter(name, old)` and its moments by `moment(old)`, in the model and in the optimizer.

    Both functions return new tensors, or parts of the old ones.
    """
    pool.release()  # what a step needs, which is of no use for this
    groups = {group["name"]: group for group in optimizer.param_groups if group["name"] in model.parameters()}
    before = {name: group["params"][0] for name, group in groups.items()}
    fresh = {name: parameter(name, old.detach()) for name, old in before.items()}
    if not lie_in_one_tensor(fresh):
        fresh = neighbors(fresh)
    for name, old in before.items():
        state = optimizer.state.pop(old, {})
        for key, value in state.items():
            state[key] = moment(value) if torch.is_tensor(value) and value.shape == old.shape else value
        optimizer.state[fresh[name]] = state
        groups[name]["params"] = [fresh[name]]
    contract.replace_parameters(model, fresh)
    for name, tensor in fresh.items():
        tensor.requires_grad_(before[name].requires_grad)
