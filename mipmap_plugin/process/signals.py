"""Lets a process that is told to end, by `timeout`, a cluster or a closed terminal, do what it does at Ctrl-C: save the state of its work, and remove
temporary files. For commands, not for libraries: signals belong to the whole process."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

# Signals whose default is to end a process at once; Windows lacks SIGHUP, and alone has SIGBREAK: Ctrl-Break, or a console that is closed.
SIGNALS = [signal.Signals[name] for name in ("SIGTERM", "SIGHUP", "SIGBREAK") if name in signal.Signals.__members__]

# Seconds in which further ones count as the same: `timeout` sends its signal to the process, and again to its group.
SAME_S = 5.0

# Seconds in which a further Ctrl-C counts as the same: an impatient hand presses twice, before it can see what the first one did.
TWICE_S = 1.0

# Seconds after which a signal is sent again, if it came where Python drops exceptions.
AGAIN_S = 0.02

# Where LLVM calls Python, through ctypes, when it has compiled a kernel: a Ctrl-C that is pressed while it compiles is heard there first.
OF_LLVM = ("_raw_object_cache_notify", "_raw_object_cache_getbuffer")

# The exit code of a process that was interrupted by Ctrl-C. Of one that another signal ended it is 128 more than the signal's number.
INTERRUPTED = 130


class Presses:
    """When Ctrl-C was pressed, or the process was told to end."""

    def __init__(self, same_s: float) -> None:
        self._same_s, self._at = same_s, -same_s

    def is_new(self) -> bool:
        """Whether this press counts: within `same_s` seconds of the last one that counted, it is taken for the same."""
        now = time.monotonic()
        if now - self._at < self._same_s:
            return False
        self._at = now
        return True


class Ending:
    """How this process was told to end, if it was."""

    code = INTERRUPTED  # to exit with

    def __init__(self) -> None:
        self.presses, self._told = Presses(TWICE_S), Presses(SAME_S)

    def pressed(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt, but not a second time in the middle of what the first one has removed or kept.

        The first one may be lost, as where Python imports; then the second one has to be heard.
        """
        if not comes_again(number, frame) and (self.presses.is_new() or not isinstance(sys.exc_info()[1], KeyboardInterrupt)):
            raise KeyboardInterrupt

    def heard(self, number: int, frame: FrameType | None) -> None:
        """Do what Ctrl-C does now; also where that is ignored, as by what a script starts in the background."""
        if comes_again(number, frame) or not self._told.is_new():
            return
        self.code = 128 + number
        on_ctrl_c = signal.getsignal(signal.SIGINT)
        if not callable(on_ctrl_c):
            raise KeyboardInterrupt
        on_ctrl_c(number, frame)


def comes_again(number: int, frame: FrameType | None) -> bool:
    """Whether Python would drop an exception in this frame and only print it; a signal of this number is then sent again a moment later.

    So it is in a finalizer, such as runs for the memory of each picture, and in a function that LLVM calls.
    """
    while frame is not None:
        if frame.f_code.co_filename == weakref.__file__ or frame.f_code.co_name in ("__del__", *OF_LLVM):
            again = threading.Timer(AGAIN_S, _send_again, (number,))
            again.daemon = True
            again.start()
            return True
        frame = frame.f_back
    return False


def _send_again(number: int) -> None:
    main = threading.main_thread().ident
    if main is not None and hasattr(signal, "pthread_kill"):
        signal.pthread_kill(main, number)
    else:  # Windows: what the main thread waits for is not broken off
        _thread.interrupt_main(signal.Signals(number))


def presses() -> Presses:
    """The presses of the running command, which all of its parts share, so that each press counts once; outside of a command, a new record."""
    ending = getattr(signal.getsignal(signal.SIGINT), "__self__", None)
    return ending.presses if isinstance(ending, Ending) else Presses(TWICE_S)


def is_ours(handler: object) -> bool:
    """Whether a handler of Ctrl-C is Python's own, or that of a command, and not of a program that this package is used in."""
    return handler is signal.default_int_handler or isinstance(getattr(handler, "__self__", None), Ending)


@contextmanager
def ctrl_c_does(handler: Callable[[int, FrameType | None], Any] | signal.Handlers) -> Iterator[None]:
    """Inside, Ctrl-C does this, and in processes that are started inside what these inherit of it (SIG_IGN); in another thread nothing changes."""
    if threading.current_thread() is not threading.main_thread():  # which alone may change what signals do
        yield
        return
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def ends_as_by_ctrl_c() -> Iterator[Ending]:
    """Inside, the signals that would end this process at once do what Ctrl-C does, but for those that it ignores already, as by `nohup`.

    Ctrl-C raises KeyboardInterrupt, as Python has it, but not again within TWICE_S while the first one is dealt with.
    """
    ending = Ending()
    if threading.current_thread() is not threading.main_thread():  # signals reach only the main thread
        yield ending
        return
    changed = [number for number in SIGNALS if signal.getsignal(number) == signal.SIG_DFL]
    for number in changed:
        signal.signal(number, ending.heard)
    if ours := signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, ending.pressed)
    try:
        yield ending
    finally:
        if ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        for number in changed if ending.code == INTERRUPTED else ():  # or the second one would end it before all is removed
            signal.signal(number, signal.SIG_DFL)
