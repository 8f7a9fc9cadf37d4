"""The precision that splats are placed and shaped in: float32 loses needles, distant splats, and places that the eye is far from the origin of."""

from __future__ import annotations

from dataclasses import replace

import torch

from mipmap_plugin.gaussians import Gaussians


def finest(device: torch.device) -> torch.dtype:
    """The finest dtype of a device: float64, which only Apple's GPUs lack."""
    return torch.float32 if device.type == "mps" else torch.float64


def exact(gaussians: Gaussians) -> Gaussians:
    """The same splats in the finest dtype, with colors of degree 0 only: harmonics are most of the memory, and need no more than float32."""
    return replace(gaussians, sh=gaussians.sh[:, :1]).to(dtype=finest(gaussians.means.device))
