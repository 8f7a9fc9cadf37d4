"""The time that is left for a start, and what can be done in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from mipmap_plugin.adaptation.start.problem import StartProblem
from mipmap_plugin.camera import Camera
from mipmap_plugin.process.clock import now

# The fraction of a time budget that the start may take. Candidates that would not be finished in it are left out.
START_SHARE = 0.5

# px, the geometric mean of a view's sides: to save time views are not made smaller than this to weigh splats in them, which takes a twentieth of a
# second.
LEAST_SIDE = 1000

# The fraction of the time left that weighing splats in the first views may take, since they are weighed again for the closed form.
WEIGHING = 1 / 3


class Clock:
    """The time that is left for a start, that of a GPU included; each unit of a work takes as long as the last time."""

    def __init__(self, seconds: float, device: torch.device) -> None:
        self._device, self._took = device, dict[str, float]()
        self._began, self._seconds = now(device), seconds

    @contextmanager
    def timing(self, work: str, amount: float = 1.0) -> Iterator[None]:
        """Note what an amount of a work takes."""
        began = now(self._device)
        yield
        self._took[work] = (now(self._device) - began) / amount

    @property
    def limited(self) -> bool:
        """Whether the time is limited at all."""
        return not math.isinf(self._seconds)

    def allows(self, work: str, amount: float = 1.0, part: float = 1.0) -> bool:
        """Whether there is time for an amount of a work; `part`: in that part of the time, from its beginning on."""
        return self._spent() + amount * self._took.get(work, 0.0) <= part * self._seconds

    def size(self, view: Camera, count: int, weigh: Callable[[float], object], most: float = 1.0) -> float:
        """The fraction of its size, at most `most`, at which so many views like `view` can be weighed; `weigh(fraction)` does it with one."""
        least = LEAST_SIDE / math.sqrt(view.width * view.height)
        if least >= most or not self.limited:
            return most
        with self.timing("trial"):
            weigh(least)
        possible = WEIGHING * (self._seconds - self._spent()) / (count * self._took["trial"])  # views of the least size, in place of each
        return min(most, least * math.sqrt(max(1.0, possible)))

    def rest(self) -> Clock:
        """Another one, of the time that is left."""
        return Clock(self._seconds - self._spent(), self._device)

    def _spent(self) -> float:
        return now(self._device) - self._began


def start_clock(problem: StartProblem) -> Clock:
    """The clock of a search for a start: without a time budget it is not limited."""
    budget = problem.config.time_budget_s
    return Clock(START_SHARE * budget if budget else math.inf, problem.base().parameters()["means"].device)
