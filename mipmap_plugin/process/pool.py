"""Large arrays in memory that is used again: fresh memory costs a page fault every 4 KiB, above a million splats half of an image's time."""

from __future__ import annotations

import math
import threading
import weakref
from collections import deque

import numpy as np

from mipmap_plugin.process.freed_memory import return_freed_memory

# Bytes of a cache line. Arrays whose rows are cache lines begin at one, unlike numpy's own, and so do large ones.
CACHE_LINE = 64

# Bytes from which on memory is used again. The system hands out memory below this size without asking the kernel for it.
LARGE = 1 << 20

# A spare block may be this many times as large as needed.
MOST_WASTE = 1.25


class Pool:
    """Blocks of memory whose arrays are gone. It never holds more spare bytes than were in use at one time."""

    def __init__(self) -> None:
        self._returned: deque[np.ndarray] = deque()  # by finalizers. Python may run these anywhere, also in here, so that they wait for no lock
        self._spare: deque[np.ndarray] = deque()
        self._used = self._most_used = 0
        self._lock = threading.Lock()

    def empty(self, shape: tuple[int, ...], dtype: type) -> np.ndarray:
        """An uninitialized array. Its memory is spare again when no array or tensor refers to it any more."""
        number = np.dtype(dtype).itemsize
        size = math.prod(shape) * number
        if size < LARGE and shape[-1] * number != CACHE_LINE:
            return np.empty(shape, dtype)
        block = self._take(size) if size >= LARGE else _new_block(size)
        start = -block.__array_interface__["data"][0] % CACHE_LINE
        array: np.ndarray = np.frombuffer(block.data[start : start + size], dtype)
        if size >= LARGE:
            weakref.finalize(array, self._returned.append, block).atexit = False  # all views of the array refer to it
        return array.reshape(shape)

    def _take(self, size: int) -> np.ndarray:
        with self._lock:
            self._collect()
            fitting = [block for block in self._spare if size <= len(block) - CACHE_LINE <= MOST_WASTE * size]
            block = min(fitting, key=len, default=None)
            if block is None:
                block = _new_block(size)
            else:
                self._spare = deque(other for other in self._spare if other is not block)
            self._used += len(block)
            self._most_used = max(self._most_used, self._used)
        return block

    def _collect(self) -> None:
        """Take back what was returned, as far as it may be kept."""
        while self._returned:
            block = self._returned.popleft()
            self._used -= len(block)
            self._spare.append(block)
        while sum(map(len, self._spare)) > self._most_used:
            self._spare.popleft()

    def release(self) -> None:
        """Free the spare blocks."""
        with self._lock:
            self._collect()
            self._spare.clear()


def _new_block(size: int) -> np.ndarray:
    return np.empty(size + CACHE_LINE, np.uint8)


_pool = Pool()


def release() -> None:
    """Free the spare memory of this process's pool, before work that needs memory of other sizes."""
    _pool.release()


def release_to_system() -> None:
    """`release`, and give the system all that was freed: what one phase needed and the next one does not."""
    release()
    return_freed_memory()


def empty(*shape: int, dtype: type = np.float32) -> np.ndarray:
    """An uninitialized array of this process's pool."""
    return _pool.empty(shape, dtype)
