"""The backward pass is compiled in another process where that pays."""

import io
import pickle

import pytest

pytest.importorskip("numba", reason="numba, the extra `cpu`, is not installed")

from mipmap_plugin.backends.cpu_kernels import ahead
from mipmap_plugin.effects import Effects


class Pipe(io.BytesIO):
    """Keeps what was written to it after it is closed."""

    written = b""

    def close(self) -> None:
        self.written = self.getvalue()
        super().close()


class Process:
    """Stands in for the process that compiles."""

    def __init__(self, *arguments: object, **options: object) -> None:
        self.stdin, self.waited_for = Pipe(), False

    def wait(self) -> None:
        self.waited_for = True


@pytest.fixture(autouse=True)
def two_threads_and_nothing_started(monkeypatch):
    monkeypatch.setattr(ahead.threads, "for_kernels", lambda: 2)
    monkeypatch.setattr(ahead.os, "cpu_count", lambda: 2)
    monkeypatch.setattr(ahead.subprocess, "Popen", Process)
    ahead._started.clear()
    yield
    ahead._started.clear()


def test_nothing_is_started_where_the_cache_has_the_kernels(monkeypatch):
    monkeypatch.setattr(ahead, "_are_compiled", lambda: True)
    assert ahead.start(False, Effects(3)) is None


def test_nothing_is_started_where_one_thread_may_be_used(monkeypatch):
    monkeypatch.setattr(ahead, "_are_compiled", lambda: False)
    monkeypatch.setattr(ahead.threads, "for_kernels", lambda: 1)
    assert ahead.start(False, Effects(3)) is None


def test_the_process_is_started_once_and_waited_for(monkeypatch):
    monkeypatch.setattr(ahead, "_are_compiled", lambda: False)
    process = ahead.start(False, Effects(3))
    ahead.wait(False, Effects(3))
    assert process is ahead.start(False, Effects(3))
    assert process.waited_for


def test_effects_that_call_the_same_kernels_start_one_process(monkeypatch):
    monkeypatch.setattr(ahead, "_are_compiled", lambda: False)
    assert ahead.start(False, Effects(3)) is ahead.start(False, Effects(3, eps2d=0.1))
    assert ahead.start(False, Effects(3)) is not ahead.start(True, Effects(3))


def test_what_merging_calls_is_compiled_after_the_backward_pass(monkeypatch):
    monkeypatch.setattr(ahead, "_are_compiled", lambda: False)
    sent = pickle.loads(ahead.start(False, Effects(0), merging=True).stdin.written)
    called = []
    for module, name in ((ahead.drawing, "draw_back"), (ahead.looking, "areas"), (ahead.pairing, "nearest_along"), (ahead.weighing, "weigh")):
        monkeypatch.setattr(module, name, lambda *arguments, name=name, **named: called.append(name))
    ahead.compile_back(*sent)
    assert called == ["draw_back", "areas", "nearest_along", "weigh"]


@pytest.mark.parametrize("has_covariances", [False, True])
def test_what_is_sent_to_the_process_compiles_a_backward_pass(monkeypatch, has_covariances):
    monkeypatch.setattr(ahead, "_are_compiled", lambda: False)
    sent = pickle.loads(ahead.start(has_covariances, Effects(0)).stdin.written)
    drawn = []
    monkeypatch.setattr(ahead.drawing, "draw_back", lambda splats, *rest: drawn.append(splats))
    ahead.compile_back(*sent)
    assert len(drawn[0].covariances) == has_covariances
