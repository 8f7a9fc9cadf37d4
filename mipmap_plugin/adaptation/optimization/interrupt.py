"""Ctrl-C takes effect between two steps instead of in the middle of one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mipmap_plugin.process.signals import presses


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Inside, Ctrl-C is only recorded, and the yielded function returns whether it was pressed since it was last called.

    A second press (`presses` tells it from the first) raises KeyboardInterrupt as soon as Python runs, which is after a call of a kernel, in the
    middle of a step: the run keeps only what it has saved. A press while the caller does what the first one asked for, such as saving, is only
    recorded again.
    """
    known, pressed = presses(), False

    def record(number: int, frame: object) -> None:
        nonlocal pressed
        if not known.is_new():
            return
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    def heard() -> bool:
        nonlocal pressed
        was, pressed = pressed, False
        return was

    if threading.current_thread() is not threading.main_thread():  # signals reach only the main thread
        yield lambda: False
        return
    before = signal.signal(signal.SIGINT, record)
    try:
        yield heard
    finally:
        signal.signal(signal.SIGINT, before)
