"""Packing: splats as a viewer keeps them in memory, rounded. Gradients go through as if nothing were rounded (straight-through)."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.backends.harmonics import C0
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Packing
from mipmap_plugin.gaussians import Gaussians


def packed(gaussians: Gaussians, camera: Camera, packing: Packing) -> Gaussians:
    """`gaussians` as `camera` sees them after `packing`. Covariances that a model gives are left as they are.

    Computed in float64, so that every backend rounds the same way.
    """
    with torch.no_grad():
        exact = gaussians.to(dtype=torch.float64)
        opacities = exact.opacities
        for step in packing.opacity:
            opacities = (opacities / step).round() * step
        rounded = {"opacities": opacities, "sh": _harmonics(exact.sh, packing)}
        if packing.log_scales is not None:
            rounded["scales"] = _scales(exact.scales, *packing.log_scales)
        if packing.axes is not None:
            rounded["quats"] = _quaternions(exact.quats, packing.axes)
        if packing.half_means:
            eye = camera.center.to(exact.means)
            rounded["means"] = (exact.means.half().double() - eye).half().double() + eye
    return replace(gaussians, **{name: _through(getattr(gaussians, name), value) for name, value in rounded.items()})


def _through(given: Tensor, rounded: Tensor) -> Tensor:
    """`rounded` with the gradient of `given`; what is not finite stays as it is."""
    rounded = torch.where(given.isfinite(), rounded.to(given), given).detach()
    return rounded if not given.requires_grad else _StraightThrough.apply(given, rounded)  # type: ignore[no-any-return]


class _StraightThrough(torch.autograd.Function):
    @staticmethod
    def forward(_ctx, given, rounded):
        return rounded

    @staticmethod
    def backward(_ctx, gradient):
        return gradient, None


def _harmonics(sh: Tensor, packing: Packing) -> Tensor:
    """[N, K, 3]. The color of degree 0 within 0..1 and the coefficients above it within -1..1, each a multiple of its step."""
    flat = ((C0 * sh[:, :1] + 0.5).clamp(0, 1) / packing.color).round() * packing.color
    parts = [(flat - 0.5) / C0]
    for degree in range(1, math.isqrt(sh.shape[1])):
        band = sh[:, degree**2 : (degree + 1) ** 2]
        step = None if packing.bands is None or degree > len(packing.bands) else packing.bands[degree - 1]
        parts.append(band if step is None else (band.clamp(-1, 1) / step).round() * step)
    return torch.cat(parts, 1)


def _scales(scales: Tensor, least: float, most: float, step: float) -> Tensor:
    """[N, 3]. Logarithms in steps; 0 stays 0."""
    logarithms = scales.abs().clamp_min(torch.finfo(scales.dtype).tiny).log()
    stepped = (((logarithms - least) / step).round() * step + least).clamp(least, most)
    return torch.where(scales == 0, 0.0, stepped.exp() * scales.sign())


def _quaternions(quats: Tensor, steps: int) -> Tensor:
    """[N, 4] wxyz. The axis of rotation on an unfolded octahedron (u, v), and the angle of 0..π, in `steps` steps each."""
    length = quats.norm(dim=1, keepdim=True)
    unit = torch.where(length > 0, quats / torch.where(length > 0, length, 1.0), quats.new_tensor([1.0, 0.0, 0.0, 0.0]))
    unit = torch.where(unit[:, :1] < 0, -unit, unit)
    angle = 2 * unit[:, 0].clamp(-1, 1).acos()
    axis = torch.where(unit[:, 1:].norm(dim=1, keepdim=True) > 1e-6, unit[:, 1:], quats.new_tensor([1.0, 0.0, 0.0]))
    axis = axis / axis.abs().sum(1, keepdim=True)
    folded = torch.where(axis[:, 2:] < 0, _folded(axis[:, :2]), axis[:, :2])
    u_v = ((folded * 0.5 + 0.5) * steps).round() / steps * 2 - 1
    z = 1 - u_v.abs().sum(1, keepdim=True)
    axis = torch.cat([torch.where(z < 0, _folded(u_v), u_v), z], 1)
    half = ((angle / math.pi) * steps).round() / steps * math.pi / 2
    turned = torch.cat([half.cos()[:, None], axis / axis.norm(dim=1, keepdim=True) * half.sin()[:, None]], 1)
    return turned * torch.where(length > 0, length, 0.0)  # a quaternion keeps its norm: its gradient is of that size


def _folded(u_v: Tensor) -> Tensor:
    """The lower half of the octahedron folded out, and back in: (1 - |v|, 1 - |u|) with the signs of (u, v)."""
    return (1 - u_v.flip(1).abs()) * torch.where(u_v >= 0, 1.0, -1.0)
