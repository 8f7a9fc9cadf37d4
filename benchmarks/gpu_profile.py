"""Which kernels take the time of one image and its gradients."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from gpu_speed import Case, Scene, calls, generated, spec_of
from torch.profiler import ProfilerActivity, profile

from mipmap_plugin.backends import get_backend

KERNELS = 8  # how many are listed
RUNS = 3


@dataclass(frozen=True)
class Profile:
    """The kernels of one backend on one case that take most of the time, forward and backward."""

    backend: str
    splats: int
    width: int  # px
    height: int  # px
    all_us: float
    kernels: list[tuple[str, float, float]]  # name, microseconds, launches


def profiles(backends: Sequence[str], cases: Sequence[Case], device: str) -> Iterator[Profile]:
    """Every backend on every case, with classic dilation."""
    made = generated(cases)
    for case in cases:
        scene = Scene.of(*case, device, made[spec_of(*case)])
        for name in backends:
            spent = kernels(calls(get_backend(name), scene, "classic")[1])
            yield Profile(name, *case, round(sum(us for _, us, _ in spent), 1), spent[:KERNELS])
        del scene


def kernels(call: Callable[[], None]) -> list[tuple[str, float, float]]:
    """Name, microseconds and launches in a call of each kernel, the slowest first; on a processor, which has none, nothing."""
    call()
    with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as profiler:
        for _ in range(RUNS):
            call()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
    spent = [event for event in profiler.key_averages() if event.device_type.name == "CUDA" and event.self_device_time_total > 0]
    rows = [(event.key[:80], round(event.self_device_time_total / RUNS, 1), round(event.count / RUNS, 1)) for event in spent]
    return sorted(rows, key=lambda row: -row[1])
