"""The raw parameters of splats, as 3DGS trains them: logarithms of scales, logits of opacities."""

from __future__ import annotations

import torch
from torch import Tensor

from mipmap_plugin.errors import ShapeError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import OF_3DGS
from mipmap_plugin.models.columns import OPACITY_MARGIN, SH_DEGREES

# World units: about the shortest length whose square is a normal float32. Its logarithm is finite, so it can be optimized.
MIN_SCALE = 1e-18


def check(parameters: dict[str, Tensor]) -> None:
    """Raise ShapeError unless the parameters are those of 3DGS, in shapes that fit together, and on one device."""
    if set(parameters) != set(OF_3DGS):
        raise ShapeError(f"parameters: expected means, scales, quats, opacities, sh0 and shN, got {', '.join(parameters)}")
    if wrong := [name for name, tensor in parameters.items() if not isinstance(tensor, Tensor)]:
        raise ShapeError(f"{wrong[0]}: expected a torch tensor, got {type(parameters[wrong[0]]).__name__}")
    means = parameters["means"]
    n = len(means) if means.dim() else 0
    bands = parameters["shN"].shape[1] if parameters["shN"].dim() == 3 else 0
    expected = {"means": (n, 3), "scales": (n, 3), "quats": (n, 4), "opacities": (n,), "sh0": (n, 1, 3), "shN": (n, bands, 3)}
    for name, shape in expected.items():
        if tuple(parameters[name].shape) != shape:
            raise ShapeError(f"{name}: expected shape {list(shape)}, got {list(parameters[name].shape)}")
        if parameters[name].device != means.device:
            raise ShapeError(f"{name}: it is on {parameters[name].device}, but means are on {means.device}; move all to one device")
    if 3 * bands not in SH_DEGREES:
        raise ShapeError(f"shN: {bands} coefficients fit no SH degree; 0, 3, 8, 15 or 24 do")


def raw_parameters(gaussians: Gaussians) -> dict[str, Tensor]:
    """The raw parameters of splats, as copies."""
    g = gaussians.detach()
    sh = g.sh.clone(memory_format=torch.contiguous_format)  # one tensor: joined without a copy
    own = {"means": g.means.clone(), "scales": log(g.scales), "quats": g.quats.clone(), "opacities": logit(g.opacities)}
    return {**own, "sh0": sh[:, :1], "shN": sh[:, 1:]}


def log(scales: Tensor) -> Tensor:
    """Raw scales, finite for a scale of 0 too."""
    return scales.detach().clamp_min(MIN_SCALE).log()


def logit(opacities: Tensor) -> Tensor:
    """Raw opacities, finite for 0 and 1 too."""
    return opacities.detach().logit(eps=OPACITY_MARGIN)


def moved(tensor: Tensor, device: torch.device | str) -> Tensor:
    """A copy on another device, which requires a gradient where this tensor does."""
    return tensor.detach().to(device, copy=True).requires_grad_(tensor.requires_grad)
