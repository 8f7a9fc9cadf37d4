"""The hashes by which Triton keeps compiled kernels on disk."""

from __future__ import annotations

from typing import Any


def hash_in_order(*kernels: Any) -> None:
    """Let Triton hash these kernels now, one after the other; once they are imported, before any is called.

    A hash depends on which of the functions that a kernel calls were hashed before it. By itself Triton hashes a kernel at its first call, so
    that another command, which calls kernels in another order, or threads that compile side by side, would not find what was compiled before.
    """
    for kernel in kernels:
        if getattr(kernel, "cache_key", None):  # Triton's interpreter keeps nothing
            # Each launch compares the constants that a kernel was compiled for with those in its module: a hundred of them in a step.
            getattr(kernel, "used_global_vals", {}).clear()
