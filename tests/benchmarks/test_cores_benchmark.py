"""`cores.py`: pieces that threads share pass at once on paper, and all are computed."""

from types import SimpleNamespace

import cores
import pytest

from mipmap_plugin.backends.cpu_kernels.threads import Team
from mipmap_plugin.process import threads


@pytest.fixture
def work(monkeypatch):
    """Work that takes so many seconds of the thread's time."""
    clock = [0.0]
    monkeypatch.setattr(cores, "time", SimpleNamespace(thread_time=lambda: clock[0]))

    def takes(seconds):
        clock[0] += seconds
        return seconds

    return takes


def test_views_go_to_the_thread_that_is_free_first(work):
    paper = cores.Paper()
    with threads.limited(2, shared=True):
        assert list(paper.side_by_side(work, [1, 1, 1, 3], 2)) == [1, 1, 1, 3]
    assert paper.now() == 4  # 1 + 3 beside 1 + 1


def test_python_holds_up_the_other_threads_at_most_for_as_long_as_it_takes(work):
    paper = cores.Paper()
    base = SimpleNamespace(adapt=lambda scale: list(paper.side_by_side(work, [2, 2], 2)))
    assert paper.count(base, 0.5) == (2, 4, 0)


def test_chunks_of_kernels_are_all_computed_and_pass_at_once(work):
    paper, done = cores.Paper(), []

    def kernel(start, stop):
        done.extend(range(start, stop))
        work(stop - start)

    paper.share_all(Team(4), kernel, [(64, ())])
    assert sorted(done) == list(range(64))
    assert paper.now() == pytest.approx(16, abs=0.01)


def test_what_no_thread_shares_is_alone(work):
    paper = cores.Paper()
    assert paper.count(SimpleNamespace(adapt=lambda scale: work(5)), 0.5) == (5, 5, 5)
