"""The backward pass with the step of the optimizer in it: gradients of some rows are summed over the views, used, and forgotten.

No gradient of all splats exists, which would take as much memory as they do, and be written, read and split some ten times.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from torch import Tensor

from mipmap_plugin.backends.base import AdamStep
from mipmap_plugin.backends.cpu_kernels import adam
from mipmap_plugin.backends.cpu_kernels.drawing import ROWS, Drawing, add_views
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH
from mipmap_plugin.backends.cpu_kernels.records import SplatArrays
from mipmap_plugin.backends.cpu_kernels.threads import team
from mipmap_plugin.process.pool import empty


def descend(splats: SplatArrays, views: Sequence[tuple[Drawing, np.ndarray]], step: AdamStep) -> None:
    """Move the raw parameters of `splats` down the gradient, which follows from each view's gradient table (`drawing.tile_gradients`)."""
    count = len(splats.means)
    threads = team(count * len(views))
    raw, firsts, seconds = (_arrays(tensors) for tensors in (step.raw, step.first, step.second))
    rates = _rates(step, splats.sh.shape[1])
    means_gradient = None if step.means_gradient is None else step.means_gradient.numpy()
    new_first, new_second = 1 - step.betas[0], 1 - step.betas[1]
    settings = tuple(np.float32(number) for number in (new_first, new_second, new_first * step.nesterov, step.correction, step.eps))

    def move(start: int, stop: int) -> None:
        room = _Room(splats, min(ROWS, stop - start))
        for first in range(start, stop, ROWS):
            last = min(first + ROWS, stop)
            grads = room.zeros(last - first)
            add_views(first, last, splats, views, grads)
            if means_gradient is not None:
                means_gradient[first:last] = grads.means
            adam.step(first, last, splats, grads, raw, firsts, seconds, rates, settings)

    threads.share(move, count, of_rows=True)


def activated(raw: Mapping[str, Tensor]) -> SplatArrays:
    """The activated splats of raw parameters. They share means and coefficients with these."""
    given = _arrays(raw)
    splats = given._replace(quats=np.empty_like(given.quats), scales=np.empty_like(given.scales), opacities=np.empty_like(given.opacities))
    team(len(given.means)).share(adam.activate_rows, len(given.means), given, splats, of_rows=True)
    return splats


class _Room:
    """Memory for the gradients of some rows, as one block, so that it is cleared at once."""

    def __init__(self, splats: SplatArrays, rows: int) -> None:
        self._shapes = [array.shape[1:] if len(array) else None for array in splats]
        self._block = empty(rows * sum(math.prod(shape) for shape in self._shapes if shape is not None))

    def zeros(self, rows: int) -> SplatArrays:
        """Gradients of so many rows, all 0."""
        self._block.fill(0)
        arrays, at = [], 0
        for shape in self._shapes:
            size = 0 if shape is None else rows * math.prod(shape)
            arrays.append(self._block[at : at + size].reshape(-1, *(shape or (3, 3))) if shape != () else self._block[at : at + size])
            at += size
        return SplatArrays(*arrays)


def compile_step() -> None:
    """Compile the step, and the activation before the first one, of no splat."""
    rows = SplatArrays(*(np.empty((0, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (1, 3), (3, 3))))
    rates = SplatArrays(*[np.empty(0, np.float32)] * len(rows))
    adam.step(0, 0, rows, rows, rows, rows, rows, rates, (np.float32(0),) * 5)
    adam.activate_rows(0, 0, rows, rows)


def _arrays(tensors: Mapping[str, Tensor]) -> SplatArrays:
    arrays = {name: tensor.detach().numpy() for name, tensor in tensors.items()}
    return SplatArrays(**arrays, covariances=np.empty((0, 3, 3), np.float32))


def _rates(step: AdamStep, bands: int) -> SplatArrays:
    """The rate of each number in 16 rows, for each parameter: kernels move 16 numbers at a time, wherever a row ends."""
    columns = {"means": 3, "quats": 4, "scales": 3, "opacities": 1}
    rates = {name: np.full(WIDTH * size, step.rates[name], np.float32) for name, size in columns.items()}
    sh = np.full((WIDTH, bands, 3), step.rates["shN"], np.float32)
    sh[:, 0] = step.rates["sh0"]
    return SplatArrays(**rates, sh=sh.ravel(), covariances=np.empty(0, np.float32))
