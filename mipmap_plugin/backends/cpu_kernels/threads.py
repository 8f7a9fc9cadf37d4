"""Threads for kernels: as many as torch uses, and without torch's own in their way."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch

# Work is cut finer than there are threads: crowded tiles take longer than others. Much finer, and handing it out would take time.
RANGES_PER_THREAD = 16


@dataclass(frozen=True)
class Team:
    """Threads that take work as they come free: the caller's, and those of a pool."""

    threads: int
    pool: ThreadPoolExecutor | None

    def share(self, kernel: Callable[..., None], count: int, *arguments) -> None:
        """Run `kernel(start, stop, *arguments)` over 0..count."""
        if self.pool is None:
            kernel(0, count, *arguments)
            return
        step = max(1, -(-count // (self.threads * RANGES_PER_THREAD)))
        starts = iter(range(0, count, step))

        def work() -> None:
            for start in starts:
                kernel(start, min(start + step, count), *arguments)

        others = [self.pool.submit(work) for _ in range(self.threads - 1)]
        work()
        for other in others:
            other.result()


@contextmanager
def team() -> Iterator[Team]:
    """As many threads as torch uses.

    They live as long as one image: an idle pool would not survive a fork, and two callers would get in each other's way.
    """
    threads = torch.get_num_threads()
    if threads == 1:
        yield Team(1, None)
        return
    _dismiss_idle_threads()
    with ThreadPoolExecutor(threads - 1) as pool:
        yield Team(threads, pool)


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
