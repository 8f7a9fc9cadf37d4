"""Warnings of an adaptation. A warm-up gives none, because they would be about its only view, and not about those of the run that follows."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from mipmap_plugin import errors

# Not a filter of Python's warnings, which all threads have in common.
_silent: ContextVar[bool] = ContextVar("_silent", default=False)
_held: ContextVar[list[str] | None] = ContextVar("_held", default=None)


def warn(text: str) -> None:
    """`errors.warn`, unless this is inside `silent`; inside `held` it is kept."""
    if _silent.get():
        return
    texts = _held.get()
    if texts is None:
        errors.warn(text)
    else:
        texts.append(text)


@contextmanager
def silent() -> Iterator[None]:
    """Adaptations of this thread warn of nothing inside."""
    token = _silent.set(True)
    try:
        yield
    finally:
        _silent.reset(token)


@contextmanager
def held() -> Iterator[list[str]]:
    """What adaptations of this thread warn of inside, for whoever knows whether what they make is kept. What ends in an exception warns of it."""
    texts: list[str] = []
    token = _held.set(texts)
    try:
        yield texts
    except BaseException:
        for text in texts:
            errors.warn(text)
        raise
    finally:
        _held.reset(token)
