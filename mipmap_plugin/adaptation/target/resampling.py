"""Separable resampling on any device, in any floating-point type, differentiable.

Torch has some of these filters on some devices, depending on its version. Here all are products with a matrix, of which each block of
rows takes from few columns: a gather and a product of small matrices.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

# So many pixels of the result share a block: larger ones hold more zeros, smaller ones gather more pixels twice. Of 8, 16 and 32 the
# fastest from 800 to 50, 100, 200 and 400 px and back.
BLOCK = 8

# Recent sizes whose weights are kept; a run asks for a handful.
KEPT = 64

Taps = tuple[Tensor, Tensor, Tensor]  # [M] row of the result, [M] row that it takes from, [M] weight in float64


class Blocks(NamedTuple):
    """A matrix of which each block of rows takes from few columns."""

    rows: int
    weights: Tensor  # [blocks, BLOCK, few]
    columns: Tensor  # [blocks, few]

    def times(self, values: Tensor) -> Tensor:
        """[columns, C] -> [rows, C]"""
        return (self.weights @ values[self.columns]).flatten(0, 1)[: self.rows]


class _Resample(torch.autograd.Function):
    """The matrix is constant, so that the gradient is its transpose's product: no scattered additions, whose order a GPU leaves open."""

    @staticmethod
    def forward(ctx, values, matrix, transposed):
        ctx.matrices = matrix, transposed
        return matrix.times(values)

    @staticmethod
    def backward(ctx, gradient):
        matrix, transposed = ctx.matrices
        return _Resample.apply(gradient, transposed, matrix), None, None


def resample(image: Tensor, size: tuple[int, int], method: str) -> Tensor:
    """[H, W, C] -> [size[0], size[1], C] by one of `TAPS`."""
    # The axis that shrinks more goes first: less is left for the other.
    for axis in sorted((0, 1), key=lambda axis: size[axis] / image.shape[axis]):
        if image.shape[axis] != size[axis]:
            first = image.movedim(axis, 0)
            matrices = matrix_of(first.shape[0], size[axis], method, image.device, image.dtype)
            image = _Resample.apply(first.flatten(1), *matrices).unflatten(1, first.shape[1:]).movedim(0, axis)
    return image


@lru_cache(maxsize=KEPT)
def matrix_of(count: int, wanted: int, method: str, device: torch.device, dtype: torch.dtype) -> tuple[Blocks, Blocks]:
    """The matrix [wanted, count] that resamples `count` pixels to `wanted`, and its transpose."""
    rows, columns, weights = TAPS[method](count, wanted)
    both = _blocks(rows, columns, weights, (wanted, count)), _blocks(columns, rows, weights, (count, wanted))
    matrix, transposed = (Blocks(part.rows, part.weights.to(device, dtype), part.columns.to(device)) for part in both)
    return matrix, transposed


def _blocks(rows: Tensor, columns: Tensor, weights: Tensor, shape: tuple[int, int]) -> Blocks:
    """A matrix of `shape` from its entries [M]; of entries in one place the sum."""
    count, block = -(-shape[0] // BLOCK), rows // BLOCK
    used, entry = torch.unique(block * shape[1] + columns, return_inverse=True)  # each column of each block once, in order
    owner = used // shape[1]
    place = torch.arange(len(used)) - torch.searchsorted(owner, torch.arange(count))[owner]
    few = int(place.max()) + 1
    taken = torch.zeros(count, few, dtype=torch.long).index_put((owner, place), used % shape[1])
    dense = weights.new_zeros(count, BLOCK, few).index_put((block, rows % BLOCK, place[entry]), weights, accumulate=True)
    return Blocks(shape[0], dense, taken)


def _kernel(function: Callable[[Tensor], Tensor], support: float) -> Callable[[int, int], Taps]:
    """Taps of a kernel that is widened where the image shrinks, cut off at the border and normalized, exactly as Pillow's (Resample.c)."""

    def taps(count: int, wanted: int) -> Taps:
        scale = count / wanted
        widened = max(scale, 1.0)
        center = (torch.arange(wanted, dtype=torch.float64)[:, None] + 0.5) * scale
        low = (center - support * widened + 0.5).long().clamp_min(0)
        high = (center + support * widened + 0.5).long().clamp_max(count)
        columns = low + torch.arange(int((high - low).max()))
        weights = torch.where(columns < high, function((columns - center + 0.5) / widened), 0.0)
        return _flat(columns.clamp_max(count - 1), weights / weights.sum(1, keepdim=True))

    return taps


def _area(count: int, wanted: int) -> Taps:
    """The mean of all pixels that a pixel of the result touches."""
    row = torch.arange(wanted)[:, None]
    low, high = row * count // wanted, -(-(row + 1) * count // wanted)
    columns = low + torch.arange(int((high - low).max()))
    return _flat(columns.clamp_max(count - 1), (columns < high) / (high - low).double())


def _bilinear(count: int, wanted: int) -> Taps:
    """Between the two nearest pixels, however far apart those of the result are."""
    place = ((torch.arange(wanted, dtype=torch.float64) + 0.5) * count / wanted - 0.5).clamp(0, count - 1)
    low = place.long()
    share = place - low
    return _flat(torch.stack([low, (low + 1).clamp_max(count - 1)], 1), torch.stack([1 - share, share], 1))


def _flat(columns: Tensor, weights: Tensor) -> Taps:
    """From [rows, taps], without what weighs nothing."""
    rows, tap = (weights != 0).nonzero(as_tuple=True)
    return rows, columns[rows, tap], weights[rows, tap]


def _cubic(x: Tensor) -> Tensor:
    """Keys' cubic with a = -1/2 (1981)."""
    x = x.abs()
    return torch.where(x < 1, (1.5 * x - 2.5) * x * x + 1, torch.where(x < 2, ((-0.5 * x + 2.5) * x - 4) * x + 2, 0.0))


def _lanczos(x: Tensor) -> Tensor:
    """Three lobes (Duchon 1979)."""
    return torch.where((x >= -3) & (x < 3), torch.sinc(x) * torch.sinc(x / 3), 0.0)


TAPS = {"box": _area, "area": _area, "bilinear": _bilinear, "pil-bicubic": _kernel(_cubic, 2.0), "lanczos": _kernel(_lanczos, 3.0)}
