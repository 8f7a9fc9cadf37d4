"""The hashes by which Triton keeps compiled kernels on disk."""

from __future__ import annotations

from typing import Any


def hash_in_order(*kernels: Any) -> None:
    """Let Triton hash these kernels now, one after the other; once they are imported, before any is called.

    In Triton 3.6 and 3.7 a hash depends on which of the functions that a kernel calls were hashed before it. By itself Triton hashes a kernel at
    its first call, so that another command, which calls kernels in another order, or threads that compile side by side, would not find what was
    compiled before.

    From then on the constants of their modules must not change: launches do not compare them any more, which are a hundred in a step.
    """
    for kernel in kernels:
        getattr(kernel, "cache_key", "")  # which hashes it; Triton's interpreter has neither this nor the constants
        getattr(kernel, "used_global_vals", {}).clear()
