"""Pieces of work in a process of their own: what breaks the process, or takes too long, ends with a sentence, and the next piece begins."""

from __future__ import annotations

import gc
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from gpu_records import Failure

Result = TypeVar("Result")

# After an error of CUDA's a process can launch nothing more.
BROKEN = ("CUDA error", "CUDA driver error")

# Comes after the last record of a piece that is not to be done again, whatever it showed.
DONE = "done"

# A piece that takes so many times as long as is expected, and the time to start a process and compile, is cut off.
PATIENCE, STARTING_S = 4.0, 90.0


@dataclass(frozen=True)
class Work:
    """One piece: what it is of, and the function that yields its records. It is begun where its expected seconds are left."""

    part: str
    backend: str
    what: str
    seconds: float
    function: Callable[..., Iterable[Any]]  # of a module, so that another process finds it
    arguments: tuple[Any, ...] = ()

    @property
    def title(self) -> str:
        return ": ".join(filter(None, [self.part, self.backend, self.what]))


class Worker:
    """A process that does one piece after the other, and its successor once one broke it."""

    def __init__(self) -> None:
        self._process: Any = None
        self._pipe: Any = None

    def records(self, work: Work, ends: float) -> Iterator[Any]:
        """The records of a piece as they come, Failures among them, and DONE; one that takes until `ends` (`time.monotonic`) is cut off."""
        ends = min(ends, time.monotonic() + PATIENCE * work.seconds + STARTING_S)
        self._send(work)
        while True:
            if not self._pipe.poll(max(0.0, ends - time.monotonic())):
                yield self._over(work, "it was cut off, for its time was over", late=True)
                return
            try:
                record = self._pipe.recv()
            except EOFError:
                yield self._over(work, "its process ended")
                yield DONE
                return
            yield record
            if record == DONE:
                return
            if isinstance(record, Failure) and any(sign in record.reason for sign in BROKEN):
                self.close()
                yield DONE
                return

    def close(self) -> None:
        """End the process, and all that it started."""
        if self._process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.kill()
            self._process.join()
            self._pipe.close()
        self._process = self._pipe = None

    def _send(self, work: Work) -> None:
        if self._process is None:
            context = get_context("spawn")
            self._pipe, theirs = context.Pipe()
            self._process = context.Process(target=_serve, args=(theirs,))
            self._process.start()
            theirs.close()
        self._pipe.send(work)

    def _over(self, work: Work, reason: str, late: bool = False) -> Failure:
        self.close()
        return Failure(work.backend, work.what, reason, late)


_kept: list[Any] = []  # functions that keep what they returned last


def kept(function: Callable[..., Result]) -> Callable[..., Result]:
    """A function that keeps what it returned last, for the next piece of the same part."""
    _kept.append(lru_cache(maxsize=1)(function))
    return _kept[-1]


def _serve(pipe: Connection) -> None:
    """Do what comes through the pipe until its other end is closed."""
    os.setsid()  # so that what is started here can be ended together
    part = ""
    while True:
        try:
            work: Work = pipe.recv()
        except EOFError:
            return
        if work.part != part:
            forget()
        part = work.part
        try:
            for record in work.function(*work.arguments):
                pipe.send(record)
        except Exception as error:  # a kernel that does not compile, or memory that does not suffice, is a finding
            pipe.send(Failure.of(work.backend, work.what, error))
        pipe.send(DONE)


def forget() -> None:
    """Free what is kept, so that it does not count as memory of another part."""
    for function in _kept:
        function.cache_clear()
    gc.collect()


def carry_out(works: list[Work], began: float, ends: float, until: dict[str, float]) -> Iterator[tuple[Work, Any]]:
    """The records of all pieces in their order, each with its piece; DONE after the last of a piece that is not to be done again.

    until: the fraction of the time after which no piece of a part is begun; it waits until all others had their turn.
    """
    worker, later = Worker(), list[Work]()
    try:
        for turn in (works, later):
            for work in turn:
                allowed = ends if turn is later else began + until[work.part] * (ends - began)
                if time.monotonic() + work.seconds <= allowed:
                    for record in worker.records(work, ends):
                        yield work, record
                elif turn is works:
                    later.append(work)
                else:
                    yield work, Failure(work.backend, work.what, f"no time was left, for it takes {work.seconds:.0f} s", late=True)
    finally:
        worker.close()
