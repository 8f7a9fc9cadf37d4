"""All threads or one, whichever steps are quicker with. On a busy machine threads wait for one another; the result is the same on any number."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from mipmap_plugin.adaptation.optimization.costs import Costs
from mipmap_plugin.process import threads

# Steps of a trial with each number of threads; the shortest counts, because others are longer by chance. One step with one thread is enough if it
# takes longer than the slowest of those with all threads: on many cores it takes as long as many of them.
TRIED = 3

# Steps from one trial to the next: twice as many each time that it ends as the one before, for all threads are mostly better or mostly worse.
FIRST_INTERVAL, LONGEST_INTERVAL = 32, 512


class QuickestThreads:
    def __init__(self) -> None:
        self._most = threads.for_views()
        self._best, self._interval = self._most, FIRST_INTERVAL
        self._step = 0  # since the latest trial began
        self._times: dict[int, list[float]] = {1: [], self._most: []}  # seconds a view

    @property
    def now(self) -> int:
        """The number of threads of the next step."""
        if self._most == 1 or self._step >= 2 * TRIED:
            return self._best
        return self._most if self._step < TRIED else 1

    @contextmanager
    def step(self, views: int, costs: Costs) -> Iterator[None]:
        """A step over so many views, with as many threads as are best. What `costs` notes meanwhile is not counted."""
        if self._most == 1:
            yield
            return
        count, before, began = self.now, costs.seconds(), time.perf_counter()
        with threads.limited(count, shared=True):
            yield
        self.note(count, (time.perf_counter() - began - costs.seconds() + before) / max(1, views))

    def note(self, count: int, seconds: float) -> None:
        """Take note of the seconds that a step with so many threads took."""
        if self._step < 2 * TRIED:
            self._times[count].append(seconds)
        self._step += 1
        if TRIED < self._step < 2 * TRIED and seconds > max(self._times[self._most]):
            self._step = 2 * TRIED
        if self._step == 2 * TRIED:
            best = min(self._times, key=lambda tried: min(self._times[tried]))
            self._interval = min(2 * self._interval, LONGEST_INTERVAL) if best == self._best else FIRST_INTERVAL
            self._best = best
        if self._step >= self._interval:
            self._step, self._times = 0, {1: [], self._most: []}
