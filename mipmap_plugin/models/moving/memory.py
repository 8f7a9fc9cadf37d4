"""What a field changes at each moment, kept: evaluating it takes many times as long as drawing the splats."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter

import torch
from torch import Tensor

from mipmap_plugin.threads import for_views, side_by_side, side_by_side_now

# What a field adds to each parameter, or multiplies it by, at one moment, by name: [N, ...] each.
Changes = dict[str, Tensor]

# Bytes that are kept: 500 moments of 39,000 splats, 20 of a million.
LIMIT = 1 << 30

# Splats that are evaluated together: their numbers stay in a processor's cache from layer to layer, which halves the time.
CHUNK, CHUNK_OF_GPU = 4096, 1 << 16

# Splats and moments by which it is found out how much a field changes over a small distance.
PROBED, MOMENTS = 1024, (0.0, 0.25, 0.5, 0.75, 1.0)


@dataclass(eq=False)
class _Moment:
    """What is known of one moment: of the means that it was asked for first, which are the base's, and of those since."""

    known: list[tuple[Tensor, Changes]] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def nbytes(self) -> int:
        return sum(tensor.nbytes for place, changes in self.known for tensor in (place, *changes.values()))


class Memory:
    """A field's changes by means and moment. A model and its copies share it, so that one is evaluated where another was."""

    def __init__(self, evaluate: Callable[[Tensor, float], Changes], limit: int = LIMIT) -> None:
        """`evaluate`: means [N, 3] and a time -> their changes; `limit`: bytes."""
        self._evaluate, self._limit = evaluate, limit
        self._moments: OrderedDict[float, _Moment] = OrderedDict()
        self._lock = threading.Lock()
        self._place = torch.empty(0)  # where a moment was evaluated last
        self.seconds, self.evaluations = 0.0, 0  # that moments took, and how many there were

    def __call__(self, means: Tensor, time: float) -> Changes:
        """The changes at `means` [N, 3], without gradient; not to be changed in place."""
        moment = self._moment(time)
        with moment.lock:  # other threads may ask for the same moment
            for place, changes in moment.known:
                if torch.equal(place, means):
                    return changes
            changes = self._noted(means, time)
            moment.known = [*moment.known[:1], (self._copy(means), changes)]
        self._forget()
        return changes

    @torch.no_grad()
    def evaluate(self, means: Tensor, time: float) -> Changes:
        """The changes at `means` [N, 3], of a part of the splats after the other, on a processor by all threads that views share."""
        chunks = means.detach().split(CHUNK if means.device.type == "cpu" else CHUNK_OF_GPU)
        parts = list(side_by_side(lambda part: self._evaluate(part, time), chunks, for_views()))
        return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}

    def knows(self, means: Tensor, time: float) -> bool:
        """Whether the changes at `means` [N, 3] need not be evaluated."""
        moment = self._moments.get(time)
        return moment is not None and any(torch.equal(place, means) for place, _ in moment.known)

    def _copy(self, means: Tensor) -> Tensor:
        """A copy of the means, which all moments share that are evaluated there."""
        with self._lock:
            if not torch.equal(self._place, means):
                self._place = means.clone()
            return self._place

    def _noted(self, means: Tensor, time: float) -> Changes:
        """`evaluate`, whose time is noted; of several moments side by side the time that passed."""
        began = perf_counter()
        changes = self.evaluate(means, time)
        with self._lock:
            self.seconds += (perf_counter() - began) / side_by_side_now()
            self.evaluations += 1
        return changes

    def keep_rows(self, means: Tensor, rows: Tensor, left: Tensor) -> None:
        """Know what is known at `means` [N, 3] also of their `rows` [M], which are `left` [M, 3]."""
        for moment in list(self._moments.values()):
            with moment.lock:
                for place, changes in moment.known:
                    if torch.equal(place, means):
                        kept = left, {name: tensor[rows] for name, tensor in changes.items()}
                        moment.known = [*moment.known[:1], kept]
                        break

    @torch.no_grad()
    def slope(self, means: Tensor, distance: float) -> float:
        """How much farther or less far, relative to it, the field moves splats at this `distance` (world units) from `means` [N, 3]; at most 1 if
        they only keep together."""
        some = means.detach()[:: max(1, len(means) // PROBED)]
        beside = some + distance / 3**0.5
        apart = [shift(self.evaluate(beside, time)) - shift(self.evaluate(some, time)) for time in MOMENTS]
        return float(torch.stack(apart).square().sum(-1).mean().sqrt()) / distance

    def _moment(self, time: float) -> _Moment:
        with self._lock:
            moment = self._moments.setdefault(time, _Moment())
            self._moments.move_to_end(time)
        return moment

    def _forget(self) -> None:
        """Forget the moments that were of use longest ago, once there are too many."""
        with self._lock:
            sizes = [moment.nbytes() for moment in self._moments.values()]
            total = sum(sizes)
            for size in sizes[:-1]:
                if total <= self._limit:
                    return
                self._moments.popitem(last=False)
                total -= size


def shift(changes: Changes) -> Tensor:
    """By how much the changes move the splats, [N, 3 or more]."""
    return changes["means"] if "means" in changes else next(iter(changes.values()))
