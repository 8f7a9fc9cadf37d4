"""The division of the processor's threads between torch, a backend's kernels, and views that are rendered in parallel.

Torch's own threads cost small images more than they gain, and wait for one another when other programs need the processor too. So while a
backend with threads of its own is adapted with, torch has one thread; kernels and parallel views share the others.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from contextvars import ContextVar, copy_context
from functools import cache
from operator import index
from threading import Lock, local
from typing import Any, SupportsIndex, TypeVar

import torch

from mipmap_plugin.errors import SettingsError

Item = TypeVar("Item")
Result = TypeVar("Result")

# Threads that may be asked for, for each core; more than one are of use only to tests.
MOST_PER_CORE = 16

# The number of threads that kernels and parallel views share; None: they are not shared, and torch has its own.
_shared: ContextVar[int | None] = ContextVar("_shared", default=None)

# The number of items that are computed in parallel.
_side_by_side: ContextVar[int] = ContextVar("_side_by_side", default=1)


# Whether this process was forked from one with this module, as the workers of a DataLoader are. The threads of OpenMP are not forked with it: torch
# would wait forever for those that it had, unless it has one, as DataLoader gives it.
_forked = False


def _note_fork() -> None:
    global _forked
    _forked = True
    _Limits.lock, _Limits.blocks = Lock(), _limits.depth  # the other threads are not there


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_note_fork)


def of_fork() -> AbstractContextManager[None]:
    """One thread for torch in a process that was forked, and else nothing."""
    return _torch_threads(1) if _forked else nullcontext()


def for_kernels() -> int:
    """The number of threads for one image."""
    return _shared.get() or torch.get_num_threads()


def side_by_side_now() -> int:
    """The number of items that `side_by_side` computes in parallel with this one, this one included."""
    return _side_by_side.get()


def for_views() -> int:
    """The number of views to render in parallel."""
    return _shared.get() or 1


def checked(threads: object) -> int:
    """A number of threads that may be asked for. Raises SettingsError for less than one, and for far more than the processor has."""
    most = MOST_PER_CORE * (os.cpu_count() or 1)
    with suppress(TypeError):  # of an array, which has several
        if isinstance(threads, SupportsIndex) and 1 <= index(threads) <= most:
            return index(threads)
    raise SettingsError(f"threads must be at least 1, got {threads!r}; more than {most} are of no use on this machine")


def limit_torch(threads: int) -> None:
    """Give torch this many threads for the rest of the process. Raises SettingsError, as `limited` does."""
    torch.set_num_threads(checked(threads))


@contextmanager
def limited(threads: int | None, *, shared: bool) -> Iterator[None]:
    """Use `threads` threads inside, or as many as torch has. `shared`: by kernels and parallel views, with one for torch; else by torch.

    Raises SettingsError for less than one, and for far more than the processor has.
    """
    count = (_shared.get() or _limits.usual_here()) if threads is None else checked(threads)
    token = _shared.set(count if shared else None)
    try:
        with _torch_threads(1 if shared else count):
            yield
    finally:
        _shared.reset(token)


def limited_for(backend: Any, threads: int | None) -> AbstractContextManager[None]:
    """`limited`, shared where the kernels of a backend have threads of their own."""
    return limited(threads, shared=getattr(backend, "own_threads", False))


@contextmanager
def lent_to_torch() -> Iterator[None]:
    """Inside `limited`, give torch all threads for a while, for a network."""
    with _torch_threads(for_kernels()):
        yield


class _Limits(local):
    """How torch's threads are limited at the moment. Torch has a number in each thread, and a new thread takes the one that was last set in any."""

    depth = 0  # of the blocks that this thread is in
    lock, blocks = Lock(), 0  # of all threads
    last, usual = 0, 0  # the number that a block set last, and that of before the first block

    def usual_here(self) -> int:
        """The number of this thread, but not one that it took from the block of another: that would stay when all blocks have ended."""
        now = torch.get_num_threads()
        return _Limits.usual if _Limits.blocks and not self.depth and now == _Limits.last else now

    def begin(self, count: int) -> int:
        """Set the number of this thread; return what it has to be `end`ed with."""
        with self.lock:
            before = self.usual_here()
            if not _Limits.blocks:
                _Limits.usual = before
            _Limits.blocks, self.depth = _Limits.blocks + 1, self.depth + 1
            _Limits.last = min(count, before) if _forked else count
            torch.set_num_threads(_Limits.last)
        return before

    def end(self, before: int) -> None:
        with self.lock:
            _Limits.blocks, self.depth = _Limits.blocks - 1, self.depth - 1
            torch.set_num_threads(before)


_limits = _Limits()


@contextmanager
def _torch_threads(count: int) -> Iterator[None]:
    before = _limits.begin(count)
    try:
        yield
    finally:
        _limits.end(before)


def side_by_side(function: Callable[[Item], Result], items: Sequence[Item], threads: int) -> Iterator[Result]:
    """Yield `function(item)` for all items in their order, computed in parallel; with one thread, each when it is requested.

    Gradients are recorded in every thread if the caller records them. Kernels divide the threads that there are among the items.
    """
    threads = min(threads, len(items))
    if threads <= 1:
        yield from map(function, items)
        return
    results: list[Result | None] = [None] * len(items)
    todo, grad_enabled = deque(range(len(items))), torch.is_grad_enabled()

    def work(thread: int) -> None:
        with torch.set_grad_enabled(grad_enabled):
            while todo:
                try:
                    index = todo.popleft()
                except IndexError:  # another thread was quicker
                    break
                try:
                    results[index] = function(items[index])
                except BaseException:  # Ctrl-C too, which comes in the main thread alone
                    todo.clear()
                    raise

    together, each = _side_by_side.set(threads), _shared.set(max(1, for_kernels() // threads))
    try:
        team(work, threads)
    finally:
        _shared.reset(each)
        _side_by_side.reset(together)
    yield from results  # type: ignore[misc]


def team(work: Callable[[int], None], threads: int) -> None:
    """Call `work(thread)` for 0..threads - 1, in this thread and in the free threads of a pool.

    `work` takes items from a common queue until it is empty, so that one thread completes it if no other is free.
    """
    most = max(threads, for_kernels() * side_by_side_now())
    helpers = [_pool(most - 1, os.getpid()).submit(copy_context().run, work, thread) for thread in range(1, threads)]
    try:
        work(0)
    finally:  # all have ended before an error of one of them is raised, since they write to what is the caller's
        errors = [helper.exception() for helper in helpers if not helper.cancel()]  # one that has not begun has nothing left to do
    for error in filter(None, errors):
        raise error


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """Waiting threads. Each process has its own, because threads do not survive a fork."""
    return ThreadPoolExecutor(threads, f"mipmap_plugin-{process}")
