"""Separable resampling on any device, in any floating-point type, differentiable.

Torch has some of these filters on some devices, depending on its version. Here all of them are products with a sparse matrix, in which
each block of outputs reads few inputs: a gather and a product of small matrices.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

# Output pixels per block: larger blocks hold more zeros, smaller ones gather more inputs twice. 8 is the fastest of 8, 16 and 32 from 800 to
# 50, 100, 200 and 400 px and back.
BLOCK = 8

# Number of recent sizes whose weights are cached; a run uses a handful.
CACHED_SIZES = 64

Taps = tuple[Tensor, Tensor, Tensor]  # [M] output, [M] input that it reads, [M] weight in float64


class Blocks(NamedTuple):
    """A sparse matrix in which each block of outputs reads few inputs."""

    outputs: int
    weights: Tensor  # [blocks, BLOCK, few]
    inputs: Tensor  # [blocks, few]

    def times(self, values: Tensor) -> Tensor:
        """The product with `values` [inputs, C]: [outputs, C]."""
        return (self.weights @ values[self.inputs]).flatten(0, 1)[: self.outputs]


class _Resample(torch.autograd.Function):
    """The matrix is constant, so that the gradient is the product with its transpose: no atomic additions, whose order varies on a GPU."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, matrix: Blocks, transposed: Blocks) -> Tensor:
        ctx.matrices = matrix, transposed
        return matrix.times(values)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        matrix, transposed = ctx.matrices
        return _Resample.apply(gradient, transposed, matrix), None, None  # type: ignore[no-untyped-call]  # torch's


def resample(image: Tensor, size: tuple[int, int], method: str) -> Tensor:
    """Resample an image [H, W, C] to [size[0], size[1], C] by one of `TAPS`."""
    for axis in _order(image.shape, size):
        matrix, transposed = matrix_of(image.shape[axis], size[axis], method, image.device, image.dtype)
        image = _along(axis, image, matrix, transposed)
    return image


def resample_back(gradient: Tensor, size: tuple[int, int], method: str) -> Tensor:
    """The gradient in an image [size[0], size[1], C] from that in the image [h, w, C] which it was resampled to."""
    for axis in reversed(_order(size, gradient.shape)):
        matrix, transposed = matrix_of(size[axis], gradient.shape[axis], method, gradient.device, gradient.dtype)
        gradient = _along(axis, gradient, transposed, matrix)
    return gradient


def _order(old: Sequence[int], new: Sequence[int]) -> list[int]:
    """The axes that change; first the one that shrinks more, so that less work is left for the other."""
    return [axis for axis in sorted((0, 1), key=lambda axis: new[axis] / old[axis]) if new[axis] != old[axis]]


def _along(axis: int, image: Tensor, matrix: Blocks, transposed: Blocks) -> Tensor:
    """The product with each of the lines [pixels, C] of an image [H, W, C] along an axis."""
    first = image.movedim(axis, 0)
    resampled: Tensor = _Resample.apply(first.flatten(1), matrix, transposed)  # type: ignore[no-untyped-call]  # torch's
    image = resampled.unflatten(1, first.shape[1:])
    return image.movedim(0, axis)


@lru_cache(maxsize=CACHED_SIZES)
def matrix_of(old: int, new: int, method: str, device: torch.device, dtype: torch.dtype) -> tuple[Blocks, Blocks]:
    """The matrix [new, old] that resamples `old` pixels to `new` pixels, and its transpose."""
    outputs, inputs, weights = TAPS[method](old, new)
    both = _blocks(outputs, inputs, weights, (new, old)), _blocks(inputs, outputs, weights, (old, new))
    matrix, transposed = (Blocks(part.outputs, part.weights.to(device, dtype), part.inputs.to(device)) for part in both)
    return matrix, transposed


def _blocks(outputs: Tensor, inputs: Tensor, weights: Tensor, shape: tuple[int, int]) -> Blocks:
    """The matrix of `shape` (outputs, inputs) with the entries `weights` [M]; entries at the same position are added."""
    count, block = -(-shape[0] // BLOCK), outputs // BLOCK
    used, entry = torch.unique(block * shape[1] + inputs, return_inverse=True)  # each input of each block once, in order
    block_of = used // shape[1]
    slot = torch.arange(len(used)) - torch.searchsorted(block_of, torch.arange(count))[block_of]
    few = int(slot.max()) + 1
    gathered = torch.zeros(count, few, dtype=torch.long).index_put((block_of, slot), used % shape[1])
    dense = weights.new_zeros(count, BLOCK, few).index_put((block, outputs % BLOCK, slot[entry]), weights, accumulate=True)
    return Blocks(shape[0], dense, gathered)


def _kernel(function: Callable[[Tensor], Tensor], support: float) -> Callable[[int, int], Taps]:
    """Taps of a kernel that is widened where the image shrinks, cut off at the border and normalized, exactly as Pillow's (Resample.c)."""

    def taps(old: int, new: int) -> Taps:
        scale = old / new
        widening = max(scale, 1.0)
        center = (torch.arange(new, dtype=torch.float64)[:, None] + 0.5) * scale
        low = (center - support * widening + 0.5).long().clamp_min(0)
        high = (center + support * widening + 0.5).long().clamp_max(old)
        inputs = low + torch.arange(int((high - low).max()))
        weights = torch.where(inputs < high, function((inputs - center + 0.5) / widening), 0.0)
        return _flat(inputs.clamp_max(old - 1), weights / weights.sum(1, keepdim=True))

    return taps


def _area(old: int, new: int) -> Taps:
    """The mean over the area of a new pixel: each old one counts by how much of it that covers."""
    output = torch.arange(new)[:, None]
    low, high = output * old // new, -(-(output + 1) * old // new)
    inputs = low + torch.arange(int((high - low).max()))
    # In units of 1 / new of an old pixel, so that borders that coincide are equal.
    covered = torch.minimum((inputs + 1) * new, (output + 1) * old) - torch.maximum(inputs * new, output * old)
    return _flat(inputs.clamp_max(old - 1), covered.clamp_min(0).double() / old)


def _bilinear(old: int, new: int) -> Taps:
    """Interpolation between the two nearest old pixels, without a prefilter."""
    position = ((torch.arange(new, dtype=torch.float64) + 0.5) * old / new - 0.5).clamp(0, old - 1)
    low = position.long()
    fraction = position - low
    return _flat(torch.stack([low, (low + 1).clamp_max(old - 1)], 1), torch.stack([1 - fraction, fraction], 1))


def _flat(inputs: Tensor, weights: Tensor) -> Taps:
    """Taps from inputs and weights [outputs, taps], without those of weight 0."""
    outputs, tap = (weights != 0).nonzero(as_tuple=True)
    return outputs, inputs[outputs, tap], weights[outputs, tap]


def _cubic(x: Tensor) -> Tensor:
    """Keys' cubic with a = -1/2 (1981)."""
    x = x.abs()
    return torch.where(x < 1, (1.5 * x - 2.5) * x * x + 1, torch.where(x < 2, ((-0.5 * x + 2.5) * x - 4) * x + 2, 0.0))


def _lanczos(x: Tensor) -> Tensor:
    """Lanczos' kernel with three lobes (Duchon 1979)."""
    return torch.where((x >= -3) & (x < 3), torch.sinc(x) * torch.sinc(x / 3), 0.0)


TAPS = {"box": _area, "area": _area, "bilinear": _bilinear, "pil-bicubic": _kernel(_cubic, 2.0), "lanczos": _kernel(_lanczos, 3.0)}
