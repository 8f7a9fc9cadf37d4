"""Python's garbage collection where it only costs time. It imports no other library, so that commands can call it first."""

from __future__ import annotations

import atexit
import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """Switch the collection of reference cycles off in this block, in all threads: for imports and compilers, which make many objects that stay.

    This saves a tenth of the time to import torch, and a twelfth of that to compile kernels. Where collection was off before, it stays off.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def leave_loaded() -> None:
    """Exclude all present objects from later collections. For commands, once libraries are imported: those of torch take 0.1 s to look at."""
    gc.freeze()


def leave_at_exit() -> None:
    """Look for no cycles when this process ends. For commands: among those of torch it takes 0.2 s, and the system frees all memory anyway."""
    atexit.unregister(gc.freeze)
    atexit.register(gc.freeze)
