"""A process that is killed, or hears Ctrl-C, before its n-th call that changes the file system.

What a kill leaves is what is on the disk: it is killed once for each state of that. Ctrl-C is heard by what runs on: before each call.
"""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from mipmap_plugin.formats import staging

# What Python calls in C, by the names there; torch and NumPy write through files of Python.
CALLS = {"open", "write", "flush", "close", "__exit__", "fsync", "truncate", "mkdir", "rmdir", "rename", "replace", "unlink", "remove", "flock"}
CALLS |= {"sendfile", "copy_file_range", "symlink", "link", "utime", "chmod", "fchmod"}
PLACES = {"posix", "_io", "io", "fcntl"}
# By default one in as many, where each takes long; no divisor of the calls that a file takes, so that in the end each kind has its turn.
FEW = 7


class Before:
    """As a profiler: calls `act` before the call number `number`, counting only calls before which `watched`, if given, has changed."""

    def __init__(self, number: int, act: Callable[[], Any], watched: Path | None) -> None:
        self.left, self._act, self._watched = number, act, watched
        self._seen: object = None
        self._exchange = staging.exchange.__code__  # a call of the system's own, which no profiler hears of

    def __call__(self, frame: Any, event: str, called: Any) -> None:
        if event == "call":
            counts = frame.f_code is self._exchange
        else:
            counts = event == "c_call" and called.__name__ in CALLS and bool(PLACES & {called.__module__, type(called.__self__).__module__})
        if not counts or not self._is_new():
            return
        self.left -= 1
        if self.left == 0:
            sys.setprofile(None)
            self._act()

    def _is_new(self) -> bool:
        before, self._seen = self._seen, None if self._watched is None else on_disk(self._watched)
        return self._watched is None or before != self._seen


def on_disk(folder: Path) -> set[tuple[Any, ...]]:
    """What tells two states of a folder apart."""
    paths = (os.path.join(place, name) for place, _, files in os.walk(folder) for name in ("", *files))
    return {(path, status.st_ino, status.st_size, status.st_mtime_ns) for path in paths for status in [os.lstat(path)]}


def killed(number: int, job: Callable[[], Any], folder: Path, by: int = signal.SIGKILL) -> bool:
    """Run `job`, which writes to `folder`, in a process of its own that gets a signal before its call `number`; False where it ended before."""
    watched = folder if by == signal.SIGKILL else None
    child = os.fork()
    if child == 0:
        code = 3
        try:
            signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the tests run in the background
            sys.setprofile(Before(number, lambda: signal.raise_signal(by), watched))
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


def some_of_the_calls(request: pytest.FixtureRequest) -> Iterator[int]:
    """Of the calls to be broken off at: each in the slow tests, and else one in `FEW`, which is fast."""
    return count(1, 1 if request.node.get_closest_marker("slow") else FEW)
