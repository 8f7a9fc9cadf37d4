"""A process that is told to end, as by `timeout`, by a cluster or by the terminal that is closed, does what Ctrl-C does: it keeps what can be
gone on from, and removes what is temporary. For commands, not for libraries: signals belong to the whole process."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

# Signals whose default is to end a process at once; Windows has one of them.
SIGNALS = [signal.Signals[name] for name in ("SIGTERM", "SIGHUP") if name in signal.Signals.__members__]

# Seconds in which further ones count as the same: `timeout` sends its signal to the process, and again to its group.
SAME_S = 5.0

# The exit code of a process that was interrupted by Ctrl-C. Of one that another signal ended it is 128 more than the signal's number.
INTERRUPTED = 130


class Ending:
    """How this process was told to end, if it was."""

    code = INTERRUPTED  # to exit with

    def __init__(self) -> None:
        self._heard_at = -SAME_S

    def heard(self, number: int, frame: FrameType | None) -> None:
        """Do what Ctrl-C does now; also where that is ignored, as by what a script starts in the background."""
        now = time.monotonic()
        if now - self._heard_at < SAME_S:
            return
        self._heard_at, self.code = now, 128 + number
        on_ctrl_c = signal.getsignal(signal.SIGINT)
        if not callable(on_ctrl_c):
            raise KeyboardInterrupt
        on_ctrl_c(signal.SIGINT, frame)


@contextmanager
def ends_as_by_ctrl_c() -> Iterator[Ending]:
    """Inside, the signals that would end this process at once do what Ctrl-C does, but for those that it ignores already, as by `nohup`."""
    ending = Ending()
    if threading.current_thread() is not threading.main_thread():  # signals reach only the main thread
        yield ending
        return
    changed = [number for number in SIGNALS if signal.getsignal(number) == signal.SIG_DFL]
    for number in changed:
        signal.signal(number, ending.heard)
    try:
        yield ending
    finally:
        for number in changed if ending.code == INTERRUPTED else ():  # or the second one would end it before all is removed
            signal.signal(number, signal.SIG_DFL)
