"""Python's garbage collection where it only costs time. It imports nothing, so that commands can call it first."""

from __future__ import annotations

import atexit
import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """Look for no reference cycles in this block, in any thread; for imports and compilers, which make many objects and throw few away.

    Importing torch takes a tenth of its time less, and compiling kernels a twelfth. Where collection is off already, it stays off.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def leave_loaded() -> None:
    """Pass over all objects that there are now in later collections. For commands, once libraries are imported: to look at torch's takes 0.1 s."""
    gc.freeze()


def leave_at_exit() -> None:
    """Leave all objects to the system when this process ends. For commands: looking for cycles among those of torch takes 0.2 s."""
    atexit.unregister(gc.freeze)
    atexit.register(gc.freeze)
