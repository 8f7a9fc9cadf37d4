"""The parts of the CPU backend by themselves: powers in lanes, how threads share work, and sorting."""

import time

import numpy as np
import pytest
import torch

pytest.importorskip("numba", reason="numba, the extra `cpu`, is not installed")

from mipmap_plugin.backends.cpu_kernels import kernel, powers
from mipmap_plugin.backends.cpu_kernels.lanes import PART, WIDTH
from mipmap_plugin.backends.cpu_kernels.memory import load, store
from mipmap_plugin.backends.cpu_kernels.records import Lists
from mipmap_plugin.backends.cpu_kernels.sorting import SLOT_BITS, sort
from mipmap_plugin.backends.cpu_kernels.threads import LEAST_ROWS, MIN_WORK, Team, team


def in_lanes(function, width, arguments):
    """The values of a function of `width` lanes."""

    def values(arguments, out):
        for at in range(0, len(arguments), width):
            store(out, at, function(load(arguments, at)))

    out = np.empty_like(arguments)
    kernel(values)(arguments, out)
    return out


def test_power_of_two_in_lanes():
    exponents = np.linspace(-100, 20, 1 << 16, dtype=np.float32)
    assert np.abs(in_lanes(powers.exp2, WIDTH, exponents) / np.exp2(exponents.astype(np.float64)) - 1).max() < 2e-7


@pytest.mark.parametrize(("name", "tolerance"), [("log2", {"atol": 1e-9, "rtol": 0}), ("tanh", {"atol": 0, "rtol": 4e-7})])
def test_functions_in_lanes_of_float64(name, tolerance):
    arguments = np.exp(np.linspace(-80, 80, 1 << 16))
    np.testing.assert_allclose(in_lanes(getattr(powers, name), PART, arguments), getattr(np, name)(arguments), **tolerance)


def test_little_work_runs_in_one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    counts = team(MIN_WORK - 1).threads, team(MIN_WORK).threads
    torch.set_num_threads(before)
    assert counts == (1, 2)


def test_a_team_does_all_work_exactly_once():
    done = np.zeros(1000, np.int64)

    def work(start, stop, first):
        if start == first:
            time.sleep(0.05)  # long enough for the other threads to empty this thread's queue
        done[start:stop] += 1

    for threads in (1, 2, 3):
        Team(threads).share(work, len(done), 0)
    assert (done == 3).all()


def test_chunks_of_several_jobs_shrink_and_few_rows_are_not_cut():
    lengths = [stop - start for _, start, stop in Team(2)._ranges(0, [640, 640], least=1)]
    assert lengths == [320, 160, 80, 40, 40]
    calls = []
    Team(2).share(lambda start, stop: calls.append((start, stop)), 2 * LEAST_ROWS, of_rows=True)
    assert sorted(calls) == [(0, LEAST_ROWS), (LEAST_ROWS, 2 * LEAST_ROWS)]


def test_a_few_rows_more_are_no_chunk_of_their_own():
    assert list(Team(2)._ranges(1, [8300], least=4096)) == [(0, 4150, 8300)]
    assert [stop - start for _, start, stop in Team(1)._ranges(0, [8300], least=4096)] == [4150, 4150]


@pytest.mark.parametrize("length", [0, 1, 20, 3000])
def test_depths_sort_as_floats_with_ties_in_order(length):
    rng = np.random.default_rng(length)
    depths = rng.choice(np.float32([0.25, 1e-30, 3.0, 3.0000002, 1e30]), length)
    splats = rng.permutation(length).astype(np.int32)
    entries = depths.view(np.int32).astype(np.int64) << SLOT_BITS | np.arange(length)
    members = np.empty_like(splats)
    unused = np.empty(0, np.int64)
    sort(0, 1, Lists(np.array([0, length]), members, entries, unused, unused, splats))
    order = np.argsort(depths, kind="stable")
    assert np.array_equal(entries, order) and np.array_equal(members, splats[order])
