"""Threads that pay: while something is adapted, torch keeps to one, and what is drawn side by side and the kernels of a backend share the rest.

Torch's own threads cost small images more than they gain, and wait for one another wherever other programs want a processor too.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from functools import cache
from typing import TypeVar

import torch

from mipmap_plugin.errors import SettingsError

Item = TypeVar("Item")
Result = TypeVar("Result")

# How many threads kernels and views may have; None: as many as torch has.
_count: ContextVar[int | None] = ContextVar("_count", default=None)


def count() -> int:
    """How many threads there are for kernels, and for what is drawn side by side."""
    return _count.get() or torch.get_num_threads()


@contextmanager
def shared(threads: int | None) -> Iterator[None]:
    """Torch on one thread, and `threads` for kernels and views; None: as many as torch had. Raises SettingsError."""
    if threads is not None and threads < 1:
        raise SettingsError(f"threads must be at least 1, got {threads}")
    before = torch.get_num_threads()
    token = _count.set(threads or count())
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _count.reset(token)


def side_by_side(function: Callable[[Item], Result], items: Sequence[Item], threads: int) -> Iterator[Result]:
    """The results of `function` for all items, in their order; on one thread each when it is asked for, else all at once.

    Whether gradients are recorded is the caller's setting in every thread.
    """
    if threads == 1 or len(items) < 2:
        yield from map(function, items)
        return
    results: list[Result | None] = [None] * len(items)
    todo, records = deque(range(len(items))), torch.is_grad_enabled()

    def work(thread: int) -> None:
        with torch.set_grad_enabled(records):
            while todo:
                try:
                    place = todo.popleft()
                except IndexError:  # another thread was quicker
                    break
                results[place] = function(items[place])

    team(work, min(threads, len(items)))
    yield from results  # type: ignore[misc]


def team(work: Callable[[int], None], threads: int) -> None:
    """Run `work(thread)` for 0..threads - 1, in this thread and in those of a pool that are free.

    `work` takes parts from a common list until none is left, so that one thread finishes it where no other is free.
    """
    helpers = [_pool(max(threads, count()) - 1, os.getpid()).submit(copy_context().run, work, thread) for thread in range(1, threads)]
    try:
        work(0)
    finally:
        for helper in helpers:
            if not helper.cancel():  # nothing is left for one that has not begun
                helper.result()


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """Threads that wait for work. Each process has its own, for they do not survive a fork."""
    return ThreadPoolExecutor(threads, f"mipmap_plugin-{process}")
