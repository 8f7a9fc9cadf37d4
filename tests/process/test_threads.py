"""Threads: results keep their order and their bits, and torch gets its own back."""

import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest
import tiny
import torch
from anchor_checkpoints import write
from running import wait_until

from mipmap_plugin.adaptation.target.base_images import BaseImages
from mipmap_plugin.backends import get_backend
from mipmap_plugin.commands.common import wrap
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.models import load_model
from mipmap_plugin.process import threads
from mipmap_plugin.process.torch_modes import usual_modes
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")


def parameters(count: int) -> dict[str, torch.Tensor]:
    wrapped = wrap_model(tiny.model(60), cameras=tiny.cameras(6), backend="cpu", threads=count)
    return wrapped.adapt(1 / 2, steps=4, extra_views=4).model.parameters()


def test_an_adaptation_has_the_same_bytes_on_any_number_of_threads():
    one, *more = (parameters(count) for count in (1, 2, 5))
    assert all(torch.equal(tensor, other[name]) for other in more for name, tensor in one.items())


def test_a_model_whose_splats_differ_by_view_is_validated_alike_on_any_number_of_threads(tmp_path):
    """Anchors decode other splats for each camera: in parallel, no view may see those of another."""
    model = load_model(write(tmp_path / "anchors"))

    def report(count: int) -> dict[str, float]:
        wrapped = wrap_model(model, cameras=tiny.cameras(8), backend="cpu", threads=count)
        return wrapped.adapt(1 / 2, steps=1, validation_views=16, extra_views=4).report.validation

    assert all(report(4) == report(1) for _ in range(3))


def test_base_images_keep_no_splats_that_differ_by_view(tmp_path):
    """Else a view that is rendered in parallel might get those of another."""
    model, view = load_model(write(tmp_path / "anchors")), tiny.cameras()[0]
    wrapped = wrap_model(model, backend="cpu")
    images = BaseImages(model, wrapped.backend()[0], wrapped.effects())
    images(view)
    assert images._activated is None


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_torch_has_one_thread_only_beside_kernels_with_threads_of_their_own(backend):
    before, seen = torch.get_num_threads(), []
    wrapped = wrap_model(tiny.model(20), cameras=tiny.cameras(), backend=backend, threads=3)
    wrapped.adapt(1 / 2, steps=1, extra_views=2, observe=lambda *_: seen.append((torch.get_num_threads(), threads.for_views())))
    assert set(seen) == {(1, 3) if backend == "cpu" else (3, 1)} and torch.get_num_threads() == before


@contextmanager
def torch_has(count):
    """So many threads within, and what it had before afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def test_threads_that_adapt_at_once_leave_torch_its_threads():
    """A thread that begins while another adapts has the one thread of that, and would keep it, and leave it to those that come after both."""
    begun, ended = threading.Event(), threading.Event()

    def second():
        with threads.limited(None, shared=True):
            begun.set()
            ended.wait(10)
            return threads.for_kernels()

    with torch_has(3):
        with ThreadPoolExecutor(1) as pool:
            with threads.limited(None, shared=True):
                counted = pool.submit(lambda: (second(), torch.get_num_threads()))
                begun.wait(10)
            ended.set()
            assert counted.result() == (3, 3)
        with ThreadPoolExecutor(1) as pool:
            assert torch.get_num_threads() == pool.submit(torch.get_num_threads).result() == 3


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_process_that_is_forked_while_others_adapt_has_the_threads_of_its_parent_s_thread():
    ended, inside = threading.Event(), threading.Event()

    def other():
        with threads.limited(1, shared=True):
            inside.set()
            ended.wait(10)

    with ThreadPoolExecutor(1) as pool:
        torch.set_num_threads(2)
        running = pool.submit(other)
        inside.wait(10)
        torch.set_num_threads(1)  # as a DataLoader does
        child = os.fork()
        if not child:
            with threads.limited(None, shared=False):
                os._exit(torch.get_num_threads())
        ended.set()
        running.result()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1


@pytest.mark.parametrize("count", [1, 2, 4])
def test_results_come_in_the_order_of_the_items(count):
    with threads.limited(count, shared=True):
        results = list(threads.side_by_side(lambda item: (time.sleep(0.01 * (item % 2)), item)[1], range(7), count))
    assert results == list(range(7))


def test_views_are_drawn_in_several_threads():
    barrier = threading.Barrier(2, timeout=10)  # nobody gets on alone
    with threads.limited(2, shared=True):
        assert len(list(threads.side_by_side(lambda _: barrier.wait(), range(2), 2))) == 2


@pytest.mark.parametrize("records", [True, False])
def test_gradients_are_recorded_where_the_caller_records_them(records):
    with threads.limited(3, shared=True), torch.set_grad_enabled(records):
        assert set(threads.side_by_side(lambda _: torch.is_grad_enabled(), range(6), 3)) == {records}


def test_kernels_of_items_side_by_side_divide_the_threads():
    with threads.limited(8, shared=True):
        assert set(threads.side_by_side(lambda _: (threads.for_kernels(), threads.side_by_side_now()), range(5), 4)) == {(2, 4)}
        assert set(threads.side_by_side(lambda _: threads.for_kernels(), range(5), 1)) == {8}
        assert threads.for_kernels() == 8


def test_what_fails_in_a_thread_fails_for_the_caller():
    def fail(item):
        if item == 2:
            raise SettingsError("no")
        return item

    with threads.limited(2, shared=True), pytest.raises(SettingsError, match="no"):
        list(threads.side_by_side(fail, range(4), 2))


def test_all_threads_have_ended_when_one_fails():
    """They write to what is the caller's."""
    begun, ended = threading.Barrier(3), []

    def work(thread):
        begun.wait(10)
        if thread == 1:
            raise SettingsError("no")
        time.sleep(0.1)
        ended.append(thread)

    with pytest.raises(SettingsError, match="no"):
        threads.team(work, 3)
    assert sorted(ended) == [0, 2]


def test_torch_keeps_to_one_thread_and_gets_its_own_back():
    with torch_has(3):
        with threads.limited(None, shared=True):
            assert (torch.get_num_threads(), threads.for_kernels(), threads.for_views()) == (1, 3, 3)
            with threads.lent_to_torch():
                assert torch.get_num_threads() == 3
        with pytest.raises(ZeroDivisionError), threads.limited(2, shared=True):
            assert threads.for_kernels() == 2
            raise ZeroDivisionError
        with threads.limited(2, shared=False):
            assert (torch.get_num_threads(), threads.for_kernels(), threads.for_views()) == (2, 2, 1)
        assert torch.get_num_threads() == threads.for_kernels() == 3 and threads.for_views() == 1


def test_what_ends_one_thread_lets_the_others_begin_nothing_more():
    main, begun = threading.current_thread(), []

    def interrupted(item):
        begun.append(item)
        if threading.current_thread() is main:
            raise KeyboardInterrupt
        time.sleep(0.05)

    with pytest.raises(KeyboardInterrupt):
        list(threads.side_by_side(interrupted, range(100), 2))
    assert len(begun) < 10


@pytest.mark.parametrize("wrong", [0, -1, 1.5, 10**9])
def test_numbers_of_threads_that_are_none_are_refused(wrong):
    with pytest.raises(SettingsError, match="threads must be at least 1"):
        threads.limit_torch(wrong)
    with pytest.raises(SettingsError, match="threads must be at least 1"), threads.limited(wrong, shared=True):
        pass


def test_what_a_command_measures_has_the_threads_that_were_asked_for(tmp_path):
    with torch_has(1):
        wrap(Base(tiny.folder(tmp_path / "base")), threads=2)
        assert torch.get_num_threads() == 2


@pytest.mark.parametrize(("backend", "torchs"), [("cpu", 1), ("reference", 3)])
def test_a_wrapped_model_renders_with_its_own_threads(backend, torchs):
    """A backend's kernels have them, and torch one: its threads would wait for one another on a busy machine, 20 times as long as one takes."""
    before, seen = torch.get_num_threads(), []

    class Watched(type(tiny.model(2))):
        def gaussians(self, camera=None):
            seen.append((torch.get_num_threads(), threads.for_kernels()))
            return super().gaussians(camera)

    model = tiny.model(20)
    model.__class__ = Watched
    wrap_model(model, cameras=tiny.cameras(1), backend=backend, threads=3).render(tiny.cameras(1)[0])
    assert seen[-1] == (torchs, 3) and torch.get_num_threads() == before


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_worker_that_asks_for_threads_does_not_wait_for_those_of_its_parent():
    def work(large):
        torch.set_num_threads(1)  # as DataLoader does
        with threads.limited(2, shared=False):
            large.exp()

    ends_when_forked(work)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_worker_that_gives_torch_no_number_of_threads_ends_too():
    """As those of a Pool, by default on Linux before Python 3.14."""

    def work(large):
        with usual_modes():
            large.exp()

    ends_when_forked(work)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_worker_that_draws_with_the_kernels_themselves_ends_too():
    gaussians, [camera], backend = tiny.gaussians(20), tiny.cameras(1, width=100, height=100), get_backend("cpu")
    backend.render(gaussians, camera, Effects())  # compiled ahead of the fork
    ends_when_forked(lambda _: backend.render(gaussians, camera, Effects()))


def ends_when_forked(work):
    """Wait for `work` on a large tensor in a process that was forked from one whose torch had two threads."""
    large = torch.ones(1 << 18)
    with torch_has(2):
        large.exp()  # in two threads
        worker = os.fork()
        if not worker:
            try:
                work(large)
                os._exit(0)
            finally:
                os._exit(1)
    try:
        wait_until(lambda: os.waitpid(worker, os.WNOHANG) == (worker, 0), seconds=10)
    except BaseException:
        os.kill(worker, signal.SIGKILL)
        os.waitpid(worker, 0)
        raise
