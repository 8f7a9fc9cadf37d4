"""Progress on a terminal: bars for work whose steps are counted, a clock for other long work, and lines above them."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any, TypeVar

from tqdm import tqdm

Item = TypeVar("Item")

# Seconds before anything is shown, and between two looks at the clock.
PATIENCE, PERIOD = 1.0, 0.5

# Since when nothing is shown, and when the last announced block ended: of short blocks one after the other the silence together is long.
_silent_since = _ended_at = -PERIOD

# The size that a terminal is taken to have which does not know its own (VT100). tqdm shows nothing there.
COLUMNS, LINES = 80, 24


class Bar(tqdm):  # type: ignore[misc]  # tqdm has no types
    """A bar on standard error, if that is a terminal."""

    def __init__(self, *args: Any, **options: Any) -> None:
        unsized = {"ncols": COLUMNS - 1, "nrows": LINES - 1} if _has_no_size() else {}
        super().__init__(*args, **{"disable": hidden(), **unsized, **options})


def _has_no_size() -> bool:
    """Whether standard error is a terminal that reports no size, such as a serial line."""
    try:
        return 0 in os.get_terminal_size(sys.stderr.fileno())
    except (OSError, ValueError, AttributeError):
        return False


def hidden() -> bool:
    """Whether no progress is shown: standard error is no terminal. A program may have none, or have put in its place a log without `isatty`."""
    try:
        return not sys.stderr.isatty()
    except (AttributeError, ValueError):  # ValueError: it is closed
        return True


def counted(items: Iterable[Item], total: int, what: str, unit: str) -> Iterator[Item]:
    """Yield the items, and show on a terminal how many of them are done."""
    bar = Bar(items, total=total, desc=what, unit=unit)
    with ticking(bar):
        yield from bar


@contextmanager
def told(what: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """Show progress on a terminal; the block calls the function that it is given with how many are done, and of how many."""
    with Bar(desc=what, unit=unit) as shown:

        def tell(done: int, total: int) -> None:
            shown.total = total
            shown.update(done - shown.n)

        yield tell


def note(line: str) -> None:
    """Write a line to standard error, above the bars that are shown there."""
    tqdm.write(line, file=sys.stderr)


def silent_since(moment: float) -> None:
    """Count the silence before the first announced block from this moment of `time.monotonic()` on."""
    global _silent_since, _ended_at
    _silent_since, _ended_at = moment, math.inf


@contextmanager
def announced(what: str) -> Iterator[None]:
    """Show `what` and its seconds on standard error while the block runs, once nothing was shown for a second, in this block and in others right
    before it; nothing where that is no terminal."""
    global _silent_since, _ended_at
    if time.monotonic() - _ended_at > PERIOD:
        _silent_since = time.monotonic()
    try:
        with nullcontext() if hidden() else meanwhile(lambda ended: _show(what, ended)):
            yield
    finally:
        _ended_at = time.monotonic()


@contextmanager
def ticking(bar: tqdm) -> Iterator[None]:
    """Let the clock of a bar go on while the block runs, also where a step takes long."""

    def refresh(ended: threading.Event) -> None:
        while not ended.wait(PATIENCE):
            bar.refresh()

    with nullcontext() if bar.disable else meanwhile(refresh):
        yield


@contextmanager
def meanwhile(work: Callable[[threading.Event], None]) -> Iterator[None]:
    """Run `work` in a thread of its own while the block runs. It has to return once the event that it is given is set, at the end of the block."""
    ended = threading.Event()
    thread = threading.Thread(target=work, args=(ended,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _show(what: str, ended: threading.Event) -> None:
    global _silent_since
    patience = max(0.0, _silent_since + PATIENCE - time.monotonic())
    if ended.wait(patience):
        return
    with Bar(bar_format="{desc}: {elapsed}", desc=what, leave=False) as line:
        line.start_t -= patience
        _silent_since = time.monotonic()
        while not ended.wait(PERIOD):
            line.refresh()
            _silent_since = time.monotonic()
