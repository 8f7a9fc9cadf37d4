"""Ctrl-C takes effect between two steps instead of in the middle of one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Inside, Ctrl-C is only recorded, and the yielded function returns whether it was pressed.

    A second one raises KeyboardInterrupt as soon as Python runs, after a call of a kernel, in the middle of a step or of what the first one saves:
    of the run is left what was saved before.
    """
    pressed = False

    def record(number: int, frame: object) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    if threading.current_thread() is not threading.main_thread():  # signals reach only the main thread
        yield lambda: False
        return
    before = signal.signal(signal.SIGINT, record)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, before)
