"""Packing: splats quantized as a viewer stores them in memory. Gradients ignore the rounding (straight-through)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import Packing
from mipmap_plugin.splatting.harmonics import C0

# The coefficients of SH degree 0 of black and of white, or what looks so: at exactly 0 and 1, where colors are clamped, the rounding of the
# coefficient to float32 would decide whether it has a gradient.
COLOR_LIMITS = (1e-6 - 0.5) / C0, (0.5 - 1e-6) / C0

# Sine of half the angle below which a rotation's axis is undefined.
LEAST_TURN = 1e-6

# Splats that are packed together, so that there is no copy of all in float64.
CHUNK = 1 << 17


def packed(gaussians: Gaussians, camera: Camera, packing: Packing | None) -> Gaussians:
    """`gaussians` after `packing`, if there is any; `camera` matters for means that are stored relative to it. Covariances are not packed.

    Computed in float64, so that every backend rounds the same way.
    """
    if packing is None:
        return gaussians
    with torch.no_grad():
        parts = [_rounded(gaussians[start : start + CHUNK], camera, packing) for start in range(0, max(1, len(gaussians)), CHUNK)]
        rounded = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return replace(gaussians, **{name: _straight_through(getattr(gaussians, name), value) for name, value in rounded.items()})


def _rounded(gaussians: Gaussians, camera: Camera, packing: Packing) -> dict[str, Tensor]:
    """What packing changes, by the names of the tensors of `gaussians` and in their dtype."""
    rounded = {}
    if packing.opacity:
        rounded["opacities"] = gaussians.opacities.double()
        for step in packing.opacity:
            rounded["opacities"] = _stepped(rounded["opacities"], step, packing.downwards)
    if packing.color is not None or packing.bands:
        rounded["sh"] = _harmonics(gaussians.sh.double(), packing)
    if packing.log_scales is not None:
        rounded["scales"] = _scales(gaussians.scales.double(), *packing.log_scales)
    if packing.quats is not None:
        rounded["quats"] = _quaternions(gaussians.quats.double(), _octahedral if packing.quats == "octahedral" else _stereographic)
    if packing.half_means:
        means = gaussians.means.double()
        eye = camera.center.to(means)
        rounded["means"] = (means.half().double() - eye).half().double() + eye
    return {name: value.to(gaussians.means) for name, value in rounded.items()}


def in_two_steps(packing: Packing) -> tuple[Packing, Packing | None]:
    """What of a packing is the same for every camera, and the rest, which is not; None if there is none."""
    return replace(packing, half_means=False), Packing(opacity=(), half_means=True) if packing.half_means else None


def round_to(values: Tensor, steps: Tensor) -> Tensor:
    """The nearest multiples of `steps`, with the gradient of `values`."""
    return _straight_through(values, (values.detach() / steps).round() * steps)


def _straight_through(values: Tensor, rounded: Tensor) -> Tensor:
    """`rounded` with the gradient of `values`; values that are not finite are not rounded."""
    rounded = torch.where(values.isfinite(), rounded.to(values), values).detach()
    if not values.requires_grad:
        return rounded
    kept: Tensor = _StraightThrough.apply(values, rounded)  # type: ignore[no-untyped-call]  # torch's
    return kept


class _StraightThrough(torch.autograd.Function):
    @staticmethod
    def forward(_ctx: Any, _values: Tensor, rounded: Tensor) -> Tensor:
        return rounded

    @staticmethod
    def backward(_ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return gradient, None


def _stepped(values: Tensor, step: float, downwards: bool = False) -> Tensor:
    return ((values / step).floor() if downwards else (values / step).round()) * step


def _harmonics(sh: Tensor, packing: Packing) -> Tensor:
    """Quantize [N, K, 3]: the color of degree 0 within 0..1, higher coefficients within -1..1, each to multiples of its step."""
    parts = [sh[:, :1]]
    if packing.color is not None:
        stepped = _stepped((C0 * sh[:, :1] + 0.5).clamp(0, 1), packing.color, packing.downwards)
        parts = [((stepped - 0.5) / C0).clamp(*COLOR_LIMITS)]
    for degree in range(1, math.isqrt(sh.shape[1])):
        band = sh[:, degree**2 : (degree + 1) ** 2]
        parts.append(_stepped(band.clamp(-1, 1), packing.bands[degree - 1]) if degree <= len(packing.bands) else band)
    return torch.cat(parts, 1)


def _scales(scales: Tensor, least: float, most: float, step: float) -> Tensor:
    """Quantize the logarithms of scales [N, 3]; 0 stays 0."""
    logarithms = scales.abs().clamp_min(torch.finfo(scales.dtype).tiny).log()
    stepped = (_stepped(logarithms - least, step) + least).clamp(least, most)
    return torch.where(scales == 0, 0.0, stepped.exp() * scales.sign())


def _quaternions(quats: Tensor, quantize: Callable[[Tensor], Tensor]) -> Tensor:
    """Quantize the rotations of [N, 4] wxyz. Norms are kept, because gradients scale with them; a zero quaternion stays."""
    length: Tensor = quats.norm(dim=1, keepdim=True)
    unit = torch.where(length > 0, quats / torch.where(length > 0, length, 1.0), quats.new_tensor([1.0, 0.0, 0.0, 0.0]))
    return quantize(torch.where(unit[:, :1] < 0, -unit, unit)) * length


def _octahedral(unit: Tensor) -> Tensor:
    """Axis-angle: the axis on an unfolded octahedron (u, v), the angle in 0..π, in 255 steps each."""
    angle = 2 * unit[:, :1].clamp(-1, 1).acos()
    axis = torch.where(unit[:, 1:].norm(dim=1, keepdim=True) > LEAST_TURN, unit[:, 1:], unit.new_tensor([1.0, 0.0, 0.0]))
    axis = axis / axis.abs().sum(1, keepdim=True)
    u_v = torch.where(axis[:, 2:] < 0, _folded(axis[:, :2]), axis[:, :2])
    u_v = _stepped(u_v * 0.5 + 0.5, 1 / 255) * 2 - 1
    z = 1 - u_v.abs().sum(1, keepdim=True)
    axis = torch.cat([torch.where(z < 0, _folded(u_v), u_v), z], 1)
    half = _stepped(angle / math.pi, 1 / 255) * math.pi / 2
    return torch.cat([half.cos(), axis / axis.norm(dim=1, keepdim=True) * half.sin()], 1)


def _folded(u_v: Tensor) -> Tensor:
    """Unfold the lower half of the octahedron, or fold it back: (1 - |v|, 1 - |u|) with the signs of (u, v)."""
    return (1 - u_v.flip(1).abs()) * torch.where(u_v >= 0, 1.0, -1.0)


def _stereographic(unit: Tensor) -> Tensor:
    """p = (x, y, z) / sqrt(1 + w) in 11, 11 and 10 bits."""
    steps = 1 / unit.new_tensor([2047.0, 2047.0, 1023.0])
    p = unit[:, 1:] / (1 + unit[:, :1]).sqrt()
    p = ((p * 0.5 + 0.5) / steps).round() * steps * 2 - 1
    squared = p.square().sum(1, keepdim=True)
    return torch.cat([1 - squared, (2 - squared).sqrt() * p], 1)
