"""What interrupts a run."""

import signal

import pressing
import pytest


@pytest.fixture
def ctrl_c(monkeypatch):
    """Called with n, Ctrl-C is pressed in the nth step from then on."""
    return pressing.in_step(monkeypatch, lambda: signal.raise_signal(signal.SIGINT))
