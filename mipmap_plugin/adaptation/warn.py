"""Warnings of an adaptation. A warm-up gives none, because they would be about its only view, and not about those of the run that follows."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from mipmap_plugin import errors

# Not a filter of Python's warnings, which all threads have in common.
_silent: ContextVar[bool] = ContextVar("_silent", default=False)


def warn(text: str) -> None:
    """`errors.warn`, unless this is inside `silent`."""
    if not _silent.get():
        errors.warn(text)


@contextmanager
def silent() -> Iterator[None]:
    """Adaptations of this thread warn of nothing inside."""
    token = _silent.set(True)
    try:
        yield
    finally:
        _silent.reset(token)
