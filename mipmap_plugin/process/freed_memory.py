"""What a process keeps of the memory that it frees. It imports no other library, so that commands can call it first."""

from __future__ import annotations

import ctypes
import platform

# Numbers of glibc's mallopt (malloc.h), and what a process keeps: blocks up to 32 MiB, the largest that it allows, and 192 MiB in all.
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
KEPT_BLOCK, KEPT_IN_ALL = 32 << 20, 3 << 26


def return_freed_memory() -> None:
    """Give the system what is freed, after a phase that needed more than the next one does (glibc; milliseconds)."""
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).malloc_trim(0)


def keep_freed_memory() -> bool:
    """Let this process keep what it frees for its next tensors; return whether the C library can (glibc). For commands, not for libraries.

    By default glibc hands blocks of a few MiB back to the system, and every tensor begins with page faults: at a million splats, a fifth
    of an optimization step.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    return bool(mallopt(MMAP_THRESHOLD, KEPT_BLOCK) and mallopt(TRIM_THRESHOLD, KEPT_IN_ALL))
