"""Ctrl-C takes effect between two steps instead of in the middle of one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from mipmap_plugin.process.signals import comes_again, is_ours, presses


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Inside, Ctrl-C is only recorded, and the yielded function returns whether it was pressed since it was last called.

    A second press (`presses` tells it from the first) raises KeyboardInterrupt as soon as Python runs, which is after a call of a kernel, in the
    middle of a step: the run keeps only what it has saved. A press while the caller does what the first one asked for, such as saving, is only
    recorded again. A program that ignores Ctrl-C, as one in the background does, or lets it end the process at once, goes on to do so; where it
    has a handler of its own, that is called, and a press is recorded if it raises KeyboardInterrupt.
    """
    known, pressed, before = presses(), False, signal.getsignal(signal.SIGINT)

    def record(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        if comes_again(number, frame) or not _interrupts(before, number, frame) or not known.is_new():
            return
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    def heard() -> bool:
        nonlocal pressed
        was, pressed = pressed, False
        return was

    elsewhere = threading.current_thread() is not threading.main_thread()  # signals reach only the main thread
    if elsewhere or before in (signal.SIG_DFL, None):  # None: a handler that is not Python's, which Python could not set again
        yield lambda: False
        return
    signal.signal(signal.SIGINT, record)
    try:
        yield heard
    finally:
        signal.signal(signal.SIGINT, before)


def _interrupts(handler: object, number: int, frame: FrameType | None) -> bool:
    """Whether a signal, of which a program's `handler` of Ctrl-C is told here, interrupts."""
    if is_ours(handler):
        return True
    if not callable(handler):  # Ctrl-C is ignored, but not what ends a command (`Ending.heard`)
        return number != signal.SIGINT
    try:
        handler(number, frame)
    except KeyboardInterrupt:
        return True
    return False
