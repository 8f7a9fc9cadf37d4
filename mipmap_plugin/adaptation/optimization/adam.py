"""Adam (Kingma and Ba 2015) with torch's fused kernel; without Nesterov's momentum, state and results are those of torch.optim.Adam.

torch.optim imports torch's compiler with the first optimizer, which takes over a second in every process and is not needed here.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

# Rows that are moved together where they are copied for it: a few hundred kB, and a multiple of what a processor computes at once.
ROWS = 2048


class Adam:
    """Adam over groups of tensors: dictionaries with `params`, `lr` and any other entries. Tensors without a gradient do not move."""

    def __init__(self, groups: Iterable[dict[str, Any]], betas: tuple[float, float], eps: float, *, nesterov: bool = False) -> None:
        """`nesterov`: as in `backends.base.AdamStep`."""
        self.param_groups, self.betas, self.eps, self.nesterov = [dict(group) for group in groups], betas, eps, nesterov
        self.state: dict[Tensor, dict[str, Any]] = {}

    @torch.no_grad()
    def step(self) -> None:
        """Move every tensor that has a gradient."""
        for group in self.param_groups:
            moving = [tensor for tensor in group["params"] if tensor.grad is not None]
            if not moving:
                continue
            torch._foreach_add_([self.state_of(tensor)["step"] for tensor in moving], 1)
            whole = [tensor for tensor in moving if tensor.is_contiguous()]
            self._move(whole, [self._values_of(tensor) for tensor in whole], group["lr"])
            for tensor in (tensor for tensor in moving if not tensor.is_contiguous()):
                self._move_parts(tensor, group["lr"])

    def _values_of(self, tensor: Tensor) -> tuple[Tensor, ...]:
        """The gradient of a tensor, the number of its steps and its moments."""
        state = self.state_of(tensor)
        assert tensor.grad is not None  # since it is to move
        return tensor.grad, state["step"], state["exp_avg"], state["exp_avg_sq"]

    def _move(self, tensors: list[Tensor], values: list[tuple[Tensor, ...]], rate: float) -> None:
        """Move contiguous tensors by the `values` of each (`_values_of`)."""
        if tensors:
            grads, steps, first, second = (list(column) for column in zip(*values, strict=True))
            torch._fused_adam_(
                tensors, grads, first, second, [], steps, lr=rate, beta1=self.betas[0], beta2=self.betas[1], weight_decay=0.0, eps=self.eps,
                amsgrad=False, maximize=False,
            )  # fmt: skip
            if self.nesterov:
                for tensor, value in zip(tensors, values, strict=True):
                    self._count_newest_again(tensor, value, rate)

    def _count_newest_again(self, tensor: Tensor, values: tuple[Tensor, ...], rate: float) -> None:
        """What a step with Nesterov's momentum adds to one without. values: as of `_move`, after the step."""
        (grad, steps, first, second), (beta1, beta2) = values, self.betas
        newest = (grad - first) * (rate * (1 - beta1) / (1 - beta1**steps))
        tensor.sub_(newest.div_(second.sqrt().mul_((1 - beta2**steps).rsqrt()).add_(self.eps)))

    def _move_parts(self, tensor: Tensor, rate: float) -> None:
        """Move a tensor whose rows do not follow each other in memory, which torch's kernel requires: some rows at a time, as copies."""
        gradient, steps, *moments = self._values_of(tensor)
        size = ROWS if tensor.device.type == "cpu" else len(tensor)
        for grad, *rows in zip(*(each.split(size) for each in (gradient, tensor, *moments)), strict=True):
            moved, first, second = (each.contiguous() for each in rows)
            self._move([moved], [(grad.contiguous(), steps, first, second)], rate)
            for each, after in zip(rows, (moved, first, second), strict=True):
                each.copy_(after)

    def zero_grad(self) -> None:
        for group in self.param_groups:
            for tensor in group["params"]:
                tensor.grad = None

    def state_of(self, tensor: Tensor) -> dict[str, Any]:
        """The number of a tensor's steps, `step`, and its moments, `exp_avg` and `exp_avg_sq`; made where there are none."""
        state = self.state.setdefault(tensor, {})
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32, device=tensor.device)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(tensor), torch.zeros_like(tensor)
        return state

    def state_dict(self) -> dict[str, Any]:
        """Return the groups, with numbers in place of their tensors, and the state of each tensor by its number."""
        tensors = [tensor for group in self.param_groups for tensor in group["params"]]
        number_of = {tensor: number for number, tensor in enumerate(tensors)}
        groups = [{**group, "params": [number_of[tensor] for tensor in group["params"]]} for group in self.param_groups]
        return {"param_groups": groups, "state": {number_of[tensor]: state for tensor, state in self.state.items()}}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Continue from the `state_dict` of an optimizer with as many tensors in its groups, in the same order."""
        tensors = [tensor for group in self.param_groups for tensor in group["params"]]
        self.param_groups = [{**group, "params": [tensors[number] for number in group["params"]]} for group in saved["param_groups"]]
        self.state = {
            tensors[number]: {name: value.to(tensors[number].device) for name, value in state.items()} for number, state in saved["state"].items()
        }
