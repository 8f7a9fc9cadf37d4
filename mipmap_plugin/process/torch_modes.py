"""Torch's modes that a caller may have set: they would change results here, or break operations in place."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from threading import Lock

import torch


@contextmanager
def usual_modes() -> Iterator[None]:
    """Inside, there is no autocast and no inference mode, and new tensors are of float32 and on the processor by default. Also a decorator."""
    with ExitStack() as stack:
        for kind in ("cpu", "cuda"):
            if torch.is_autocast_enabled(kind):
                stack.enter_context(torch.autocast(kind, enabled=False))
        if torch.is_inference_mode_enabled():
            stack.enter_context(torch.inference_mode(False))
        if torch.get_default_device().type != "cpu":
            stack.enter_context(torch.device("cpu"))
        _usual_dtype.enter()
        stack.callback(_usual_dtype.leave)
        yield


class _UsualDtype:
    """The default type, which all threads share: it is float32 from the first that enters to the last that leaves, and then the caller's again."""

    def __init__(self) -> None:
        self._lock, self._inside = Lock(), 0
        self._callers: torch.dtype | None = None

    def enter(self) -> None:
        with self._lock:
            self._inside += 1
            if (now := torch.get_default_dtype()) != torch.float32:
                self._callers = now
                torch.set_default_dtype(torch.float32)

    def leave(self) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside and self._callers is not None:
                torch.set_default_dtype(self._callers)
                self._callers = None


_usual_dtype = _UsualDtype()
