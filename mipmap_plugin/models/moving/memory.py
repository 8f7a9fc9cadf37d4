"""A memory of what a field changes at each moment: to evaluate it takes many times as long as to draw the splats."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

import torch
from torch import Tensor

from mipmap_plugin.limits import memory
from mipmap_plugin.process.clock import now
from mipmap_plugin.process.threads import for_views, side_by_side, side_by_side_now

# What a field adds to each parameter, or multiplies it by, at one moment, by name: [N, ...] each.
Changes = dict[str, Tensor]

# Changes are kept up to this number of bytes, or this part of a machine's memory if that is more. A moment of a million splats takes 40 to 240 MB.
LIMIT, PART = 1 << 30, 1 / 8

# Splats that are evaluated together: their numbers stay in a processor's cache from layer to layer, which halves the time.
CHUNK, CHUNK_OF_GPU = 4096, 1 << 16

# Splats and moments at which it is measured how much a field changes over a small distance.
PROBED, MOMENTS = 1024, (0.0, 0.25, 0.5, 0.75, 1.0)


class Memory:
    """A field's changes by means and moment. A model and its copies share it, so that none evaluates what another one has evaluated.

    For each moment it keeps the changes at the first means of all, which are the base's, and at the means that were asked for last. Without room for
    all of them it forgets changes at any other means, and then those at the base's. Nothing else makes room for something new: all moments are asked
    for in turn, so that each would be forgotten before it is of use.
    """

    def __init__(self, evaluate: Callable[[Tensor, float], Changes], limit: float | None = None) -> None:
        """`evaluate`: means [N, 3] and a time -> their changes; `limit`: bytes; None: what suits the machine."""
        self._evaluate, self._limit = evaluate, limit
        self._base: Tensor | None = None  # means [N, 3]
        self._latest: Tensor | None = None
        self._known: dict[tuple[bool, float], tuple[Tensor, Changes]] = {}  # by whether it is the base's, and time; with the means
        self._asked: dict[float, threading.Lock] = {}  # by time
        self._lock = threading.Lock()
        self.seconds, self.evaluations = 0.0, 0  # the time that all evaluations took, and their number

    def __call__(self, means: Tensor, time: float) -> Changes:
        """The changes at `means` [N, 3], without gradient; not to be changed in place."""
        with self._asked.setdefault(time, threading.Lock()):  # other threads may ask for the same moment
            if (known := self._find(means, time)) is not None:
                return known
            began = now(means.device)
            changes = self.evaluate(means, time)
            with self._lock:
                self.seconds += (now(means.device) - began) / side_by_side_now()  # of several side by side the time that passed
                self.evaluations += 1
                self._keep(means, time, changes)
        return changes

    def knows(self, means: Tensor, time: float) -> bool:
        """Whether the changes at `means` [N, 3] need not be evaluated."""
        return self._find(means, time) is not None

    @torch.no_grad()
    def evaluate(self, means: Tensor, time: float) -> Changes:
        """The changes at `means` [N, 3], evaluated chunk by chunk; on a processor in all threads that views share."""
        most = CHUNK if means.device.type == "cpu" else CHUNK_OF_GPU
        # Of equal sizes: one row, two or three of a rest come out otherwise, in the last digit, than among others, as after a pruning.
        chunks = means.detach().tensor_split(max(1, math.ceil(len(means) / most)))
        parts = list(side_by_side(lambda part: self._evaluate(part, time), chunks, for_views()))
        return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}

    def keep_of(self, means: Tensor, rows: Tensor, left: Tensor) -> None:
        """Keep what is known at `means` [N, 3] for those of their `rows` [M] that are `left` [M, 3], too."""
        with self._lock:
            known = {time: changes for (_, time), (place, changes) in self._known.items() if torch.equal(place, means)}
            for time, changes in known.items():
                self._keep(left, time, {name: tensor[rows] for name, tensor in changes.items()})

    @torch.no_grad()
    def slope(self, means: Tensor, distance: float) -> float:
        """The difference between the field's motions of splats and of places at this `distance` (world units) from them, over that distance: the root
        mean square over some of the `means` [N, 3] and some moments."""
        some = means.detach()[:: max(1, len(means) // PROBED)]
        beside = some + distance / 3**0.5
        apart = [shift(self.evaluate(beside, time)) - shift(self.evaluate(some, time)) for time in MOMENTS]
        return float(torch.stack(apart).square().sum(-1).mean().sqrt()) / distance

    def _find(self, means: Tensor, time: float) -> Changes | None:
        places = (self._known.get((is_base, time)) for is_base in (True, False))
        return next((known[1] for known in places if known is not None and torch.equal(known[0], means)), None)

    def _keep(self, means: Tensor, time: float, changes: Changes) -> None:
        """Keep what was found at `means` [N, 3], if there is room or what is of less use makes some."""
        base = self._base = means.clone() if self._base is None else self._base
        place, is_base = base, torch.equal(base, means)
        if not is_base:
            if self._latest is None or not torch.equal(self._latest, means):
                self._latest = means.clone()  # which all moments share
            place = self._latest
        stale = [key for key, (old, _) in self._known.items() if old is not base and old is not self._latest]
        of_base = [] if is_base else [key for key in self._known if key[0]]
        limit = max(LIMIT, PART * memory(means.device)) if self._limit is None else self._limit
        room = limit - sum(_bytes(known) for _, known in self._known.values()) - _bytes(changes)
        for key in (*stale, *of_base):
            if room >= 0:
                break
            room += _bytes(self._known.pop(key)[1])
        if room >= 0 or not self._known:
            self._known[is_base, time] = place, changes


def _bytes(changes: Changes) -> int:
    return sum(tensor.nbytes for tensor in changes.values())


def shift(changes: Changes) -> Tensor:
    """By how much the changes move the splats, [N, 3 or more]."""
    return changes["means"] if "means" in changes else next(iter(changes.values()))
