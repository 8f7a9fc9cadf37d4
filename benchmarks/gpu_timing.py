"""Milliseconds, memory and bandwidth of a device: a GPU's by its own events, a processor's by the clock on the wall."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch

# Bytes that are copied to measure the bandwidth: more than any cache holds.
COPIED = 1 << 30

WARM_UP = 2  # runs that do not count
BUDGET_S = 3.0  # after which no run begins once there are enough for a median
FEWEST_RUNS = 3


class Clock:
    """Times what is launched on `device`, one run after the other."""

    def __init__(self, device: str) -> None:
        self._gpu = device.startswith("cuda")

    def milliseconds(self, call: Callable[[], object], runs: int) -> float:
        """The median of `runs`, after a few that warm up; of fewer, where one takes seconds."""
        times, began = list[float](), time.perf_counter()
        while len(times) < WARM_UP + runs and (len(times) < FEWEST_RUNS or time.perf_counter() - began < BUDGET_S):
            times.append(self._once(call))
        return round(statistics.median(times[WARM_UP:] or times[1:]), 4)

    def peak_mib(self, call: Callable[[], object]) -> float:
        """The most memory that a run takes over what is held before; 0 on a processor, of which torch keeps no account."""
        if not self._gpu:
            return 0.0
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        call()
        torch.cuda.synchronize()
        return round((torch.cuda.max_memory_allocated() - before) / 2**20, 1)

    def _once(self, call: Callable[[], object]) -> float:
        if not self._gpu:
            began = time.perf_counter()
            call()
            return 1000 * (time.perf_counter() - began)
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        call()
        end.record()
        torch.cuda.synchronize()
        return start.elapsed_time(end)


def copied_per_second(device: str, size: int = COPIED) -> float:
    """Bytes read and written a second by a copy within the device's memory."""
    source = torch.ones(size // 4, device=device)
    target = torch.empty_like(source)
    return 2 * size / (Clock(device).milliseconds(lambda: target.copy_(source), 10) / 1000)
