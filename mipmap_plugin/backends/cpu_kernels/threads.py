"""Threads for kernels, after dismissing torch's idle ones."""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch

from mipmap_plugin.process import threads

# Crowded tiles take longer than others, so idle threads take chunks from the end of other threads' queues. Each chunk is CHUNK_SHARE of
# what is left of a queue, but at least MIN_CHUNK_SHARE of all work: a call takes up to 30 us, in which no other thread can begin one.
CHUNK_SHARE, MIN_CHUNK_SHARE = 1 / 2, 1 / 32

# Rows of splats that are worth a call of their own.
LEAST_ROWS = 1 << 12

# Splats plus pixels from which on a second thread pays off: this many take some 0.8 ms, and to begin a share of them 60 us.
MIN_WORK = 1 << 12


@dataclass(frozen=True)
class Team:
    """Threads that share work: the caller's and those of a pool."""

    threads: int

    def share(self, kernel: Callable[..., None], count: int, *arguments: Any, of_rows: bool = False) -> None:
        """Call `kernel(start, stop, *arguments)` on ranges that cover 0..count, in all threads. of_rows: each item is a splat, which takes little."""
        self.share_all(kernel, [(count, arguments)], of_rows=of_rows)

    def share_all(self, kernel: Callable[..., None], jobs: Sequence[tuple[int, tuple[Any, ...]]], *, of_rows: bool = False) -> None:
        """`share` for several jobs at once: the count and the arguments of each."""
        if self.threads == 1 or not jobs:
            for count, arguments in jobs:
                kernel(0, count, *arguments)
            return
        least = LEAST_ROWS if of_rows else 1
        queues = [deque(self._ranges(thread, [count for count, _ in jobs], least)) for thread in range(self.threads)]

        def work(thread: int) -> None:
            # First the thread's own queue, whose data is still in its cache; then the ends of the other queues.
            for queue in queues[thread:] + queues[:thread]:
                while queue:
                    try:
                        job, start, stop = queue.popleft() if queue is queues[thread] else queue.pop()
                    except IndexError:  # another thread was quicker
                        break
                    kernel(start, stop, *jobs[job][1])

        threads.team(work, self.threads)

    def _ranges(self, thread: int, counts: Sequence[int], least: int) -> Iterator[tuple[int, int, int]]:
        """What a thread begins with: the job, the start and the stop of each of its chunks, each at most half of what is left."""
        parts = [(count * thread // self.threads, count * (thread + 1) // self.threads) for count in counts]
        left = sum(last - first for first, last in parts)
        min_chunk = max(least, int(sum(counts) * MIN_CHUNK_SHARE))
        for job, (start, last) in enumerate(parts):
            while start < last:
                stop = start + max(min_chunk, int(left * CHUNK_SHARE))
                stop = stop if last - stop >= least // 2 else last  # a few rows more are not worth a call of their own
                yield job, start, stop
                left -= stop - start
                start = stop


def team(work: int) -> Team:
    """As many threads as kernels may use if `work`, splats plus pixels, is large enough; else one."""
    count = threads.for_kernels() if work >= MIN_WORK else 1
    if count > 1 and torch.get_num_threads() > 1:
        _dismiss_idle_threads()
    return Team(count)


def _dismiss_idle_threads() -> None:
    """End torch's idle threads; torch starts new ones at its next operation.

    GNU OpenMP keeps idle threads spinning for up to 15 ms, as long as a small image takes, on the cores that kernels need.
    """
    openmp = _openmp()
    if openmp is not None:
        openmp.omp_pause_resource_all(1)  # 1: omp_pause_soft, which keeps all settings


@cache
def _openmp() -> ctypes.CDLL | None:
    """The GNU OpenMP library that torch ships; None if there is none, or it cannot dismiss threads (before torch 2.2)."""
    libraries = sorted((Path(torch.__file__).parent / "lib").glob("libgomp*.so*"))
    openmp = ctypes.CDLL(str(libraries[0])) if libraries else None
    return openmp if hasattr(openmp, "omp_pause_resource_all") else None
