"""What tiles list: those of all views at once or, where that takes too much memory, those of one strip of a view after the other.

Splats as wide as the picture are in every tile: a view of 4K that is full of them lists each one 129,600 times. Strips are listed anew for the
backward pass, so that those of one, and while these are made of the one before, are all that is in memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from mipmap_plugin.backends.triton_kernels import views
from mipmap_plugin.backends.triton_kernels.binning import Bins, Splatted, bin_splats
from mipmap_plugin.limits import memory

# Bytes per pair while lists are made, and the part of a device's memory that all pairs may take.
PAIR_BYTES, PART = 80, 1 / 4

ALL = slice(None)


class Tiling(NamedTuple):
    """Views that are cut into tiles."""

    size: int  # px
    views: Sequence[tuple[int, int]]  # width and height, px

    @property
    def most(self) -> int:
        """The number of tiles of the largest view."""
        return max(across * down for across, down in map(self.shape, range(len(self.views))))

    def shape(self, view: int) -> tuple[int, int]:
        """The number of tiles across a view, and down."""
        width, height = self.views[view]
        return -(-width // self.size), -(-height // self.size)


class Part(NamedTuple):
    """Tiles that are drawn by one launch: all tiles of all views, or a strip of one view."""

    grid: tuple[int, int]  # the number of tiles, and of views
    views: Tensor  # their numbers; the height is the strip's
    listed: Tensor  # [pairs, 9], the records in the order of the lists: a program reads them one after the other
    bins: Bins
    view: slice = ALL
    pixels: slice = ALL
    rows: slice = ALL  # of the records

    def of(self, array: Tensor) -> Tensor:
        """These tiles' part of an array [V, pixels, ...]."""
        return array if self.view == ALL else array[self.view, self.pixels]


class Lists:
    """The lists of N splats in V views."""

    def __init__(self, splatted: Splatted, tiling: Tiling, fixed_order: bool) -> None:
        """fixed_order: whether sums over the pairs of a splat will have one."""
        self._tiling, self._fixed_order, self._most = tiling, fixed_order, most_pairs(splatted.depths.device)
        bins = bin_splats(splatted, tiling.most, tiling.size, fixed_order, self._most)
        self._split = splatted if bins is None else None
        self._whole = () if bins is None else (Part((tiling.most, len(tiling.views)), splatted.views, splatted.records[bins.splat_ids], bins),)

    def parts(self) -> Iterable[Part]:
        """All that is listed."""
        return self._whole if self._split is None else self._strips(self._split)

    def _strips(self, splatted: Splatted) -> Iterator[Part]:
        count = len(splatted.depths) // len(self._tiling.views)
        for view in range(len(self._tiling.views)):
            rows = slice(view * count, (view + 1) * count)
            records, depths, boxes = (array[rows] for array in splatted[:3])
            of_view = Splatted(records, depths, boxes, splatted.views[view : view + 1])
            for span in grouped(pairs_by_row(boxes, self._tiling.shape(view)[1]), self._most):
                yield self._strip(of_view, view, span)._replace(rows=rows)

    def _strip(self, splatted: Splatted, view: int, span: tuple[int, int]) -> Part:
        """The tiles of a view in the rows of tiles from span[0] to span[1]."""
        (first, end), size, (across, down) = span, self._tiling.size, self._tiling.shape(view)
        bins = bin_splats(splatted._replace(boxes=within(splatted.boxes, first, end)), across * down, size, self._fixed_order)
        assert bins is not None  # there is no limit to a strip, which may be one row of tiles
        bins = bins._replace(tile_offsets=bins.tile_offsets[first * across : end * across + 1].clone())
        listed, numbers = splatted.records[bins.splat_ids], splatted.views.clone()
        listed[:, 1] -= first * size  # y, from the top of the strip
        numbers[:, views.HEIGHT.value] = (numbers[:, views.HEIGHT.value] - first * size).clamp_max((end - first) * size)
        width, _ = self._tiling.views[view]
        pixels = slice(first * size * width, end * size * width)
        return Part(((end - first) * across, 1), numbers, listed, bins, slice(view, view + 1), pixels)


@lru_cache(maxsize=16)
def most_pairs(device: torch.device) -> float:
    """How many pairs are listed at once."""
    return memory(device) * PART / PAIR_BYTES


def pairs_by_row(boxes: Tensor, height: int) -> list[int]:
    """The number of pairs in each of the `height` rows of tiles."""
    first, wide = boxes[:, 1].long(), boxes[:, 2].long()
    high = boxes[:, 3] // boxes[:, 2].clamp_min(1)
    changes = torch.zeros(height + 1, dtype=torch.int64, device=boxes.device)
    changes.index_add_(0, first, wide).index_add_(0, first + high, -wide)
    return changes.cumsum(0)[:height].tolist()


def grouped(pairs: Sequence[int], most: float) -> Iterator[tuple[int, int]]:
    """Rows that follow one another, with at most so many pairs together if they are more than one: the first, and that after the last."""
    first, total = 0, 0
    for row, count in enumerate(pairs):
        if total and total + count > most:
            yield first, row
            first, total = row, 0
        total += count
    yield first, len(pairs)


def within(boxes: Tensor, first: int, end: int) -> Tensor:
    """The part of boxes [N, 4] in the rows of tiles from `first` to `end`."""
    x, y, wide, count = boxes.unbind(1)
    top, bottom = y.clamp(first, end), (y + count // wide.clamp_min(1)).clamp(first, end)
    return torch.stack([x, top, wide, wide * (bottom - top)], 1)
