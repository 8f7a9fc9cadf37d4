"""A process that is killed, or hears Ctrl-C, before its n-th call that changes the file system."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any

import pytest

from mipmap_plugin.formats import staging

# What Python calls in C, by the names there; torch and NumPy write through files of Python.
CALLS = {"open", "write", "flush", "close", "__exit__", "fsync", "truncate", "mkdir", "rmdir", "rename", "replace", "unlink", "remove", "flock"}
CALLS |= {"sendfile", "copy_file_range", "symlink", "link", "utime", "chmod", "fchmod"}
PLACES = {"posix", "_io", "io", "fcntl"}
# By default one call in as many; no divisor of the calls that a file takes, so that in the end each kind has its turn.
FEW = 7


class Before:
    """As a profiler: calls `act` before the call number `number`."""

    def __init__(self, number: int, act: Callable[[], Any]) -> None:
        self.left, self._act = number, act
        self._exchange = staging.exchange.__code__  # a call of the system's own, which no profiler hears of

    def __call__(self, frame: Any, event: str, called: Any) -> None:
        if event == "call":
            counts = frame.f_code is self._exchange
        else:
            counts = event == "c_call" and called.__name__ in CALLS and bool(PLACES & {called.__module__, type(called.__self__).__module__})
        self.left -= counts
        if counts and self.left == 0:
            sys.setprofile(None)
            self._act()


def killed(number: int, job: Callable[[], Any], by: int = signal.SIGKILL) -> bool:
    """Run `job` in a process of its own that gets the signal `by` before its call `number`; False where it ended before."""
    child = os.fork()
    if child == 0:
        code = 3
        try:
            signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the tests run in the background
            sys.setprofile(Before(number, lambda: signal.raise_signal(by)))
            job()
            sys.setprofile(None)
            code = 0
        except KeyboardInterrupt:
            code = 130
        finally:
            os._exit(code)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status in (0, 130, -signal.SIGKILL), f"the job itself failed ({status})"
    return status != 0


def numbers(request: pytest.FixtureRequest, few: int = FEW) -> Iterator[int]:
    """Of the calls to be broken off at: each in the slow tests, and else one in `few`, which is fast."""
    return count(1, 1 if request.node.get_closest_marker("slow") else few)
