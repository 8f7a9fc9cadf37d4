"""The number of threads of a step follows from how long steps took."""

import pytest

from mipmap_plugin.adaptation.optimization import quickest
from mipmap_plugin.adaptation.optimization.costs import Costs
from mipmap_plugin.adaptation.optimization.quickest import FIRST_INTERVAL, TRIED, QuickestThreads
from mipmap_plugin.process import threads


def chosen(steps: int, seconds) -> list[int]:
    """The threads of each step, where a step takes `seconds(step, threads)`."""
    with threads.limited(4, shared=True):
        choice, counts = QuickestThreads(), []
    for step in range(steps):
        counts.append(choice.now)
        choice.note(counts[-1], seconds(step, counts[-1]))
    return counts


@pytest.mark.parametrize(("busy", "best"), [(False, 4), (True, 1)])
def test_after_a_trial_the_quicker_number_is_taken(busy, best):
    """One thread takes less than all of them do at their slowest."""
    counts = chosen(FIRST_INTERVAL, lambda step, count: 1 + (count if busy else 1 / count) + 2 * (step % 2 == count % 2 == 0))
    assert counts == [4] * TRIED + [1] * TRIED + [best] * (FIRST_INTERVAL - 2 * TRIED)


def test_one_step_of_one_thread_is_enough_if_it_takes_longer_than_all_of_those_of_all_threads():
    counts = chosen(FIRST_INTERVAL, lambda step, count: (3 if count == 1 else 1) + step % 2)
    assert counts == [4] * TRIED + [1] + [4] * (FIRST_INTERVAL - TRIED - 1)


def test_trials_become_rare_while_nothing_changes():
    counts = chosen(2000, lambda step, count: 1 / count)
    assert counts.count(1) == 7  # at 0, 62, 188, 442, 952, 1462 and 1972: ever rarer


def test_a_machine_that_becomes_busy_is_noticed():
    counts = chosen(400, lambda step, count: count if step > 100 else 1 / count)
    assert counts[90] == 4 and counts[250] == 1


def test_what_truths_cost_is_not_counted(monkeypatch):
    clock = iter([0.0, 10.0])
    monkeypatch.setattr(quickest.time, "perf_counter", lambda: next(clock))
    noted, costs = [], Costs()
    with threads.limited(4, shared=True):
        choice = QuickestThreads()
        monkeypatch.setattr(choice, "note", lambda count, seconds: noted.append((count, seconds)))
        with choice.step(2, costs):
            assert threads.for_kernels() == 4
            costs.truths["a view"] = 4.0
    assert noted == [(4, 3.0)]


def test_one_thread_tries_nothing():
    with threads.limited(1, shared=True):
        choice = QuickestThreads()
        with choice.step(1, Costs()):
            assert threads.for_kernels() == 1
    assert choice.now == 1
