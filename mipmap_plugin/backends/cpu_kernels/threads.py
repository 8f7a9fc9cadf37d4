"""Threads for kernels: as many as torch uses, and without torch's own in their way."""

from __future__ import annotations

import ctypes
import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import torch

# Work is cut finer than there are threads: crowded tiles take longer than others. Much finer, and handing it out would take time.
RANGES_PER_THREAD = 16


@dataclass(frozen=True)
class Team:
    """Threads that share work: the caller's, and those of a pool."""

    threads: int

    def share(self, kernel: Callable[..., None], count: int, *arguments) -> None:
        """Run `kernel(start, stop, *arguments)` over 0..count."""
        if self.threads == 1:
            kernel(0, count, *arguments)
            return
        step = max(1, -(-count // (self.threads * RANGES_PER_THREAD)))
        ranges = [(start, min(start + step, count)) for start in range(0, count, step)]
        cuts = [len(ranges) * thread // self.threads for thread in range(self.threads + 1)]
        parts = [deque(ranges[first:last]) for first, last in pairwise(cuts)]

        def work(thread: int) -> None:
            # Always the same part first, which is still in this processor's cache; of the others' what they come to last.
            for part in parts[thread:] + parts[:thread]:
                while part:
                    try:
                        start, stop = part.popleft() if part is parts[thread] else part.pop()
                    except IndexError:  # another thread was quicker
                        break
                    kernel(start, stop, *arguments)

        others = [_pool(self.threads - 1, os.getpid()).submit(work, thread) for thread in range(1, self.threads)]
        work(0)
        for other in others:
            if not other.cancel():  # nothing is left for one that has not begun
                other.result()


def team() -> Team:
    """As many threads as torch uses."""
    threads = torch.get_num_threads()
    if threads > 1:
        _dismiss_idle_threads()
    return Team(threads)


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """Threads that wait for work. Each process has its own, for they do not survive a fork."""
    return ThreadPoolExecutor(threads, f"mipmap_plugin-{process}")


def _dismiss_idle_threads() -> None:
    """Let torch's threads go; it starts new ones at its next operation.

    GNU OpenMP keeps idle threads spinning for up to 15 ms, as long as a small image takes, on the very cores that kernels want.
    """
    openmp = _openmp()
    if openmp is not None:
        openmp.omp_pause_resource_all(1)  # 1: omp_pause_soft, which forgets no setting


@cache
def _openmp() -> ctypes.CDLL | None:
    """The GNU OpenMP that torch brought; None where it brought none."""
    libraries = sorted((Path(torch.__file__).parent / "lib").glob("libgomp*.so*"))
    return ctypes.CDLL(str(libraries[0])) if libraries else None
