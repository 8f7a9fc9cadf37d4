"""Threads for kernels, without torch's own in their way."""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import torch

from mipmap_plugin import threads

# Crowded tiles take longer than others. So a thread's part is cut finer and finer, each time by this share of what is left, for others
# take from its end; but not finer than this share of all, or handing it out would take time.
CUT, LEAST_CUT = 1 / 2, 1 / 128

# Splats and pixels for which a second thread is worth waking: all that is done with them takes some 3 ms.
LEAST_WORK = 1 << 14


@dataclass(frozen=True)
class Team:
    """Threads that share work: the caller's, and those of a pool."""

    threads: int

    def share(self, kernel: Callable[..., None], count: int, *arguments) -> None:
        """Run `kernel(start, stop, *arguments)` over 0..count."""
        if self.threads == 1:
            kernel(0, count, *arguments)
            return
        ends = [count * thread // self.threads for thread in range(self.threads + 1)]
        parts = [deque(cut(first, last, max(1, int(count * LEAST_CUT)))) for first, last in pairwise(ends)]

        def work(thread: int) -> None:
            # Always the same part first, which is still in this processor's cache; of the others' what they come to last.
            for part in parts[thread:] + parts[:thread]:
                while part:
                    try:
                        start, stop = part.popleft() if part is parts[thread] else part.pop()
                    except IndexError:  # another thread was quicker
                        break
                    kernel(start, stop, *arguments)

        threads.team(work, self.threads)


def cut(first: int, last: int, least: int) -> Iterator[tuple[int, int]]:
    """Ranges of first..last, ever smaller ones."""
    while first < last:
        stop = min(last, first + max(least, int((last - first) * CUT)))
        yield first, stop
        first = stop


def team(work: int) -> Team:
    """As many threads as there are for kernels, if there is enough work, in splats and pixels."""
    most = threads.count() if work >= LEAST_WORK else 1
    if most > 1 and torch.get_num_threads() > 1:
        _dismiss_idle_threads()
    return Team(most)


def _dismiss_idle_threads() -> None:
    """Let torch's threads go; it starts new ones at its next operation.

    GNU OpenMP keeps idle threads spinning for up to 15 ms, as long as a small image takes, on the very cores that kernels want.
    """
    openmp = _openmp()
    if openmp is not None:
        openmp.omp_pause_resource_all(1)  # 1: omp_pause_soft, which forgets no setting


@cache
def _openmp() -> ctypes.CDLL | None:
    """The GNU OpenMP that torch brought; None where it brought none, or one that cannot dismiss threads (before torch 2.2)."""
    libraries = sorted((Path(torch.__file__).parent / "lib").glob("libgomp*.so*"))
    openmp = ctypes.CDLL(str(libraries[0])) if libraries else None
    return openmp if hasattr(openmp, "omp_pause_resource_all") else None
