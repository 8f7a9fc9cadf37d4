"""Long work that has no steps to count says on a terminal what it is and how long it has taken."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from typing import TypeVar

from tqdm import tqdm

Item = TypeVar("Item")

# Seconds before anything is shown, and between two looks at the clock.
PATIENCE, PERIOD = 1.0, 0.5


def counted(items: Iterable[Item], total: int, what: str, unit: str) -> Iterator[Item]:
    """Yield the items, and show on a terminal how many of them there were."""
    bar = tqdm(items, total=total, desc=what, unit=unit, disable=None)
    with ticking(bar):
        yield from bar


@contextmanager
def told(what: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """Show on a terminal how many there are of how many, as the function that the block is given is told."""
    with tqdm(desc=what, unit=unit, disable=None) as shown:

        def tell(done: int, total: int) -> None:
            shown.total = total
            shown.update(done - shown.n)

        yield tell


def note(line: str) -> None:
    """Write a line to standard error, above the bars that are shown there."""
    tqdm.write(line, file=sys.stderr)


@contextmanager
def announced(what: str) -> Iterator[None]:
    """Show `what` and its seconds on standard error while the block runs, once it has taken a second; nothing where that is no terminal."""
    with _meanwhile(lambda ended: _show(what, ended)) if sys.stderr.isatty() else nullcontext():
        yield


@contextmanager
def ticking(bar: tqdm) -> Iterator[None]:
    """Let the clock of a bar go on while the block runs, also where a step takes long."""

    def refresh(ended: threading.Event) -> None:
        while not ended.wait(PATIENCE):
            bar.refresh()

    with nullcontext() if bar.disable else _meanwhile(refresh):
        yield


@contextmanager
def _meanwhile(show: Callable[[threading.Event], None]) -> Iterator[None]:
    """Call `show` in a thread of its own, which is to return when the event is set: at the end of the block."""
    ended = threading.Event()
    clock = threading.Thread(target=show, args=(ended,), daemon=True)
    clock.start()
    try:
        yield
    finally:
        ended.set()
        clock.join()


def _show(what: str, ended: threading.Event) -> None:
    if ended.wait(PATIENCE):
        return
    with tqdm(bar_format="{desc}: {elapsed}", desc=what, leave=False) as line:
        line.start_t -= PATIENCE
        while not ended.wait(PERIOD):
            line.refresh()
