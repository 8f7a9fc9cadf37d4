"""Fewer, larger splats for a coarser image: splats of like color that share a few target pixels become one.

At x1/8 thousands of splats share a pixel, and a classic renderer dilates every one of them. A group is replaced by the splat with
the same weight, mean and covariance (moment matching, as in Runnalls 2007, "Kullback-Leibler approach to Gaussian mixture
reduction"), each splat weighing as much as it shows: opacity times surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mipmap_plugin.backends.projection import rotations
from mipmap_plugin.gaussians import Gaussians

# Target pixels: the side of the largest cell whose splats may become one. An object of two colors needs 5 to come down to a tenth of its
# splats at x1/8; a meadow at x1/4, which stays at three fifths, would lose another 0.6 dB with 8.
LARGEST_CELL = 5.0

# A cell is tried at most this often smaller or larger; each halves what is left to know of its size.
TRIES = 12

# Steps per channel of the base color, 0..1, that count as like.
SHADES = 6

# The exponent of Thomsen's formula for the surface of an ellipsoid; its error is 1.061 % at most.
THOMSEN = 1.6075

# What a splat of degree 0 adds to 0.5 for a coefficient of 1.
SH_C0 = 0.28209479177387814

# 2**64 over the golden ratio, odd, as a signed number: spreads the bits of small integers (Knuth, TAOCP 6.4).
GOLDEN = 0x9E3779B97F4A7C15 - 2**64

# No opacity reaches 1, whose logit is infinite.
MOST_OPAQUE = 0.999


def merge(gaussians: Gaussians, pixel: Tensor, share: float) -> Gaussians:
    """Splats merged until about `share` (0..1) of them is left, or cells have grown to `LARGEST_CELL`.

    `pixel` [N]: the size of a target pixel at each splat, world units.
    """
    low, high = 0.0, LARGEST_CELL
    groups = _Groups.of(gaussians, pixel, high)
    if groups.count < share * len(gaussians):
        for _ in range(TRIES):
            middle = (low + high) / 2
            groups = _Groups.of(gaussians, pixel, middle)
            low, high = (middle, high) if groups.count > share * len(gaussians) else (low, middle)
        groups = _Groups.of(gaussians, pixel, high)
    return gaussians if groups.count == len(gaussians) else _moment_matched(gaussians, groups)


@dataclass(frozen=True)
class _Groups:
    """Which group [N] each splat goes into, of how many."""

    index: Tensor
    count: int

    @classmethod
    def of(cls, gaussians: Gaussians, pixel: Tensor, cell: float) -> _Groups:
        """Cells of `cell` target pixels; a splat that is larger than its cell stays alone."""
        # Pixels are rounded to octaves, so that neighbors share a grid.
        octave = pixel.log2().round()
        side = cell * octave.exp2()
        place = (gaussians.means / side[:, None]).floor()
        shade = ((0.5 + SH_C0 * gaussians.sh[:, 0]).clamp(0, 1) * SHADES).floor()
        alone = torch.where(gaussians.scales.amax(dim=1) > side, torch.arange(len(side), device=side.device), -1)
        columns = [octave, *place.unbind(1), *shade.unbind(1), alone]
        _, index = torch.unique(_hashed([column.long() for column in columns]), return_inverse=True)
        return cls(index, int(index.max()) + 1)


def _hashed(columns: Sequence[Tensor]) -> Tensor:
    """[N] one 64-bit number for each row, so that rows are compared by one sort, not eight."""
    mixed = torch.zeros_like(columns[0])
    for column in columns:
        mixed = (mixed ^ column) * GOLDEN
        mixed = mixed ^ (mixed >> 29)
    return mixed


def _moment_matched(gaussians: Gaussians, groups: _Groups) -> Gaussians:
    """One splat a group."""

    def total(values: Tensor) -> Tensor:
        return values.new_zeros(groups.count, *values.shape[1:]).index_add_(0, groups.index, values)

    shows = gaussians.opacities * _surface(gaussians.scales)
    weights = shows.clamp_min(torch.finfo(shows.dtype).tiny)
    weights = weights / total(weights)[groups.index]
    means = total(weights[:, None] * gaussians.means)
    away = gaussians.means - means[groups.index]
    axes = rotations(gaussians.quats) * gaussians.scales[:, None, :]
    covariances = total(weights[:, None, None] * (axes @ axes.mT + away[:, :, None] * away[:, None, :]))
    variances, directions = torch.linalg.eigh(covariances.double())
    directions = directions * torch.linalg.det(directions).sign()[:, None, None]  # rotations, not reflections
    scales = variances.clamp_min(0).sqrt().to(means)
    opacities = (total(shows) / _surface(scales).clamp_min(torch.finfo(shows.dtype).tiny)).clamp_max(MOST_OPAQUE)
    sh = total(weights[:, None, None] * gaussians.sh)
    return replace(gaussians, means=means, quats=_quaternions(directions).to(means), scales=scales, opacities=opacities, sh=sh)


def _surface(scales: Tensor) -> Tensor:
    """[N] the surface of ellipsoids with half-axes `scales` [N, 3], up to a factor (Thomsen's formula)."""
    a, b, c = scales.unbind(-1)
    return (((a * b) ** THOMSEN + (a * c) ** THOMSEN + (b * c) ** THOMSEN) / 3) ** (1 / THOMSEN)


def _quaternions(rotation: Tensor) -> Tensor:
    """[N, 4] wxyz of rotations [N, 3, 3], from the largest of its components (Shepperd 1978), so that nothing cancels."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in rotation.unbind(-2))
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], dim=1)
    w, x, y, z = squares.unbind(-1)
    rows = [
        torch.stack([w, zy - yz, xz - zx, yx - xy], dim=1),
        torch.stack([zy - yz, x, yx + xy, xz + zx], dim=1),
        torch.stack([xz - zx, yx + xy, y, zy + yz], dim=1),
        torch.stack([yx - xy, xz + zx, zy + yz, z], dim=1),
    ]
    quats = torch.stack(rows, dim=1)[torch.arange(len(rotation), device=rotation.device), squares.argmax(dim=1)]
    return quats / quats.norm(dim=1, keepdim=True)
