"""The compiled half of the CPU backend, and the only place that imports numba.

numba counts references of arrays, and of records that hold some; each count is an atomic operation, and a few for every splat cost
more than all of its geometry. So a kernel takes arrays out of their records where it begins, and what it calls for every splat is
given pointers, numbers and tuples of them (`memory`). Such functions are always inlined: numba passes lanes through memory otherwise.
"""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numba

# What Python calls: kept compiled on disk, and run side by side in threads. Division by zero gives infinity, as in numpy.
kernel: Any = numba.njit(cache=True, nogil=True, error_model="numpy")

# What only kernels call: without a way in from Python it compiles faster, and called from there it crashes.
inner: Any = numba.njit(error_model="numpy", forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)  # type: ignore[call-overload]


def _forget_stale() -> None:
    """Drop machine code older than any source here: numba looks only at the file of a kernel itself, not at those that it calls."""
    folder = Path(__file__).parent
    newest = max(source.stat().st_mtime for source in folder.glob("*.py"))
    for compiled in folder.glob("__pycache__/*.nb[ci]"):
        with suppress(OSError):  # another process may be quicker; in a folder that cannot be written numba keeps none
            if compiled.stat().st_mtime < newest:
                compiled.unlink()


_forget_stale()
