"""The coefficients of a color: its constant band and the others, which files and optimizers keep apart, as one tensor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mipmap_plugin.process.pool import LARGE, empty


def joined(sh0: Tensor, shN: Tensor) -> Tensor:
    """[N, K, 3] from the constant band sh0 [N, 1, 3] and the others shN [N, K - 1, 3].

    No copy is made of neighbors in memory (`neighbors`) that are large or need no gradient. Other large tensors on a CPU lie in memory that
    is used again, and so do their gradients: above a million splats, joining and splitting them in fresh memory takes a third of an
    optimization step.
    """
    differentiated = torch.is_grad_enabled() and (sh0.requires_grad or shN.requires_grad)
    if _are_neighbors(sh0, shN) and not differentiated:
        return _whole(sh0, shN)
    large = sh0.device.type == "cpu" and sh0.dtype == torch.float32 and 4 * shN.numel() >= LARGE
    return _Joined.apply(sh0, shN) if large else torch.cat([sh0, shN], dim=1)  # type: ignore[no-untyped-call]  # torch's


def neighbors(parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The parameters, with copies of sh0 and shN, if there are both, that are parts of one tensor: `joined` need not copy them again.

    The copies require no gradient.
    """
    if not {"sh0", "shN"} <= parameters.keys():
        return dict(parameters)
    whole = torch.cat([parameters["sh0"].detach(), parameters["shN"].detach()], dim=1)
    return {**parameters, "sh0": whole[:, :1], "shN": whole[:, 1:]}


def lie_in_one_tensor(parameters: Mapping[str, Tensor]) -> bool:
    """Whether sh0 and shN are there, and neighbors in memory."""
    return {"sh0", "shN"} <= parameters.keys() and _are_neighbors(parameters["sh0"], parameters["shN"])


def one_tensor(sh0: Tensor, shN: Tensor) -> Tensor | None:
    """The contiguous tensor [N, K, 3] that both neighbors are parts of, without a gradient; None for others."""
    return _whole(sh0, shN) if _are_neighbors(sh0, shN) else None


def _whole(sh0: Tensor, shN: Tensor) -> Tensor:
    """The tensor that both neighbors are parts of, without a gradient."""
    count, others, channels = shN.shape
    return torch.as_strided(sh0.detach(), (count, 1 + others, channels), shN.stride(), sh0.storage_offset())


def _are_neighbors(sh0: Tensor, shN: Tensor) -> bool:
    """Whether both are parts of one contiguous tensor."""
    same_memory = sh0.untyped_storage().data_ptr() == shN.untyped_storage().data_ptr()
    contiguous = 3 * (1 + shN.shape[1]), 3, 1
    return same_memory and shN.storage_offset() == sh0.storage_offset() + 3 and sh0.stride() == shN.stride() == contiguous


class _Joined(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh0: Tensor, shN: Tensor) -> Tensor:
        if _are_neighbors(sh0, shN):
            return _whole(sh0, shN)
        count, bands, channels = shN.shape
        return torch.cat([sh0, shN], dim=1, out=torch.from_numpy(empty(count, bands + 1, channels)))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        parts = gradient[:, :1], gradient[:, 1:]
        return tuple(_copy(part) if wanted else None for part, wanted in zip(parts, ctx.needs_input_grad, strict=True))


def _copy(part: Tensor) -> Tensor:
    return torch.from_numpy(empty(*part.shape)).copy_(part)
