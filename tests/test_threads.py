"""Threads: results keep their order and their bits, torch gets its own back, and what takes long is announced."""

import io
import sys
import threading
import time

import pytest
import tiny
import torch

from mipmap_plugin import progress, threads
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.wrap import wrap_model


def parameters(count: int) -> dict[str, torch.Tensor]:
    wrapped = wrap_model(tiny.model(60), cameras=tiny.cameras(6), backend="cpu", threads=count)
    return wrapped.adapt(1 / 2, steps=4, extra_views=4).model.parameters()


def test_an_adaptation_has_the_same_bytes_on_any_number_of_threads():
    one, *more = (parameters(count) for count in (1, 2, 5))
    assert all(torch.equal(tensor, other[name]) for other in more for name, tensor in one.items())


@pytest.mark.parametrize("count", [1, 2, 4])
def test_results_come_in_the_order_of_the_items(count):
    with threads.shared(count):
        results = list(threads.side_by_side(lambda item: (time.sleep(0.01 * (item % 2)), item)[1], range(7), count))
    assert results == list(range(7))


def test_views_are_drawn_in_several_threads():
    barrier = threading.Barrier(2, timeout=10)  # nobody gets on alone
    with threads.shared(2):
        assert len(list(threads.side_by_side(lambda _: barrier.wait(), range(2), 2))) == 2


@pytest.mark.parametrize("records", [True, False])
def test_gradients_are_recorded_where_the_caller_records_them(records):
    with threads.shared(3), torch.set_grad_enabled(records):
        assert set(threads.side_by_side(lambda _: torch.is_grad_enabled(), range(6), 3)) == {records}


def test_what_fails_in_a_thread_fails_for_the_caller():
    def fail(item):
        if item == 2:
            raise SettingsError("no")
        return item

    with threads.shared(2), pytest.raises(SettingsError, match="no"):
        list(threads.side_by_side(fail, range(4), 2))


def test_torch_keeps_to_one_thread_and_gets_its_own_back():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with threads.shared(None):
            assert (torch.get_num_threads(), threads.count()) == (1, 3)
        with pytest.raises(ZeroDivisionError), threads.shared(2):
            assert threads.count() == 2
            raise ZeroDivisionError
        assert torch.get_num_threads() == threads.count() == 3
    finally:
        torch.set_num_threads(before)


def test_no_threads_are_refused():
    with pytest.raises(SettingsError, match="at least 1, got 0"), threads.shared(0):
        pass


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("terminal, patience, line", [(True, 0.01, "merging x0.25: 00:0"), (True, 60, ""), (False, 0.01, "")])
def test_long_work_is_announced_on_a_terminal_alone(terminal, patience, line, monkeypatch):
    errors = Terminal() if terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", errors)
    monkeypatch.setattr(progress, "PATIENCE", patience)
    monkeypatch.setattr(progress, "PERIOD", 0.01)
    with progress.announced("merging x0.25"):
        time.sleep(0.2 if patience < 1 else 0)
    assert line in errors.getvalue() and bool(errors.getvalue()) == bool(line)
