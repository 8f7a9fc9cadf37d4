"""In which order views are used: introduced one after the other, then repeated in rounds. All follows from one seed.

In a round that is spread out, views that follow each other look from all sides, however many of them are taken. The gradients of a step then
differ less from those of all views: worth 0.15 dB on objects at equal steps of four views.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.limits import derived_seed

# The number of a view, or the halves of several, of which the second may have one more.
Halves = int | tuple[Any, Any]


class ViewSchedule:
    """The views that each step uses. It has no state, so that a run can be resumed at any step."""

    def __init__(self, views: Sequence[Camera], config: AdaptConfig) -> None:
        self._rounds, self._seed, self._steps = Rounds(views, config.seed, spread_out=config.order == "spread"), config.seed, config.steps
        self._max_views, self._warm_up = min(config.views_per_step, len(views)), config.warm_up_steps
        self._gathering = math.ceil(config.gathering * config.steps)  # steps during which new views are introduced

    @property
    def view_count(self) -> int:
        return len(self._rounds.views)

    def __call__(self, step: int, progress: float) -> list[Camera]:
        """Return the views of a step: at first its new views and some of the earlier ones, later the next ones of a round through all.

        progress: 0..1, how much of the run is over; with a time budget this may be more than the step number implies.
        """
        pace, count = max(step, int(progress * self._steps)), self._views_in_step(step)
        if pace >= self._gathering:
            first = self.draws_before(step)
            return [self._rounds(first + number) for number in range(count)]
        before, after = self._introduced(pace - 1), self._introduced(pace)
        new = range(before, min(after, before + count))
        generator = torch.Generator().manual_seed(derived_seed(self._seed, step))
        repeated = torch.randperm(before, generator=generator)[: count - len(new)].tolist()
        return [self._rounds(draw) for draw in (*new, *repeated)]

    def _views_in_step(self, step: int) -> int:
        """The number of views of a step. It rises during the warm-up: the first gradients are alike in all views, so few views suffice."""
        return self._max_views if self._warm_up <= max(0, step) else math.ceil(self._max_views * (step + 1) / self._warm_up)

    def draws_before(self, step: int) -> int:
        """The number of draws of all earlier steps; that of the warm-up is rounded up to whole steps, so that rounds align with steps."""
        if step < self._warm_up:
            return self._draws_in_warm_up(step)
        return (math.ceil(self._draws_in_warm_up(self._warm_up) / self._max_views) + step - self._warm_up) * self._max_views

    def _draws_in_warm_up(self, step: int) -> int:
        """The number of draws of all earlier steps of the warm-up: from which step on each has a first view, a second one, ..."""
        return sum(max(0, step - number * self._warm_up // self._max_views) for number in range(self._max_views))

    def _introduced(self, step: int) -> int:
        """The number of views introduced up to a step: spread evenly, at least one per step, and no more per step than it uses."""
        count = max(self._views_in_step(step), step + 1, math.ceil(len(self._rounds.views) * (step + 1) / self._gathering))
        return min(count, self.draws_before(step + 1), len(self._rounds.views))


class Rounds:
    """Each view once per round, in an order that follows from (seed, round) alone, so that a run can be resumed at any step."""

    def __init__(self, views: Sequence[Camera], seed: int, *, spread_out: bool = False) -> None:
        """`spread_out`: neighbors look from all sides; otherwise the order is shuffled."""
        self.views, self._seed = list(views), seed
        self._halves = halves_of(range(len(views)), poses(views)) if spread_out and views else None
        self._round = -1
        self._order: list[int] = []

    def __call__(self, draw: int) -> Camera:
        """The `draw`-th view since the beginning of the run."""
        round_number, position = divmod(draw, len(self.views))
        if round_number != self._round:
            generator = torch.Generator().manual_seed(derived_seed(self._seed, round_number))
            order = torch.randperm(len(self.views), generator=generator).tolist() if self._halves is None else spread(self._halves, generator)
            self._round, self._order = round_number, order
        return self.views[self._order[position]]


def poses(views: Sequence[Camera]) -> Tensor:
    """What tells views apart, [V, 6] float64: where they are, in units of their mean distance from the middle, and where they look."""
    centers = torch.stack([view.center for view in views])
    offsets = centers - centers.mean(0)
    size = float(offsets.norm(dim=1).mean())
    return torch.cat([offsets / size if size > 0 else offsets, torch.stack([view.viewmat[2, :3] for view in views])], dim=1)


def halves_of(members: Sequence[int], at: Tensor) -> Halves:
    """The `members`, one or more, with the poses `at` [V, 6], cut where they are most spread out."""
    if len(members) < 2:
        return members[0]
    rows = at[list(members)]
    axis = int(rows.var(0, unbiased=False).argmax())
    ordered = [members[place] for place in rows[:, axis].argsort(stable=True).tolist()]
    half = len(members) // 2
    return halves_of(ordered[:half], at), halves_of(ordered[half:], at)


def spread(halves: Halves, generator: torch.Generator) -> list[int]:
    """An order of the views of `halves`, in which these take turns, each in such an order itself.

    So neighbors are of different halves, any four of different quarters, and so on (as in van der Corput's sequence, 1935). Chance decides
    which comes first.
    """
    if isinstance(halves, int):
        return [halves]
    low, high = (spread(half, generator) for half in halves)
    first, second = (low, high) if len(low) == len(high) and int(torch.randint(2, (), generator=generator)) else (high, low)
    order = [view for pair in zip(first, second, strict=False) for view in pair]
    return order + first[len(second) :]
