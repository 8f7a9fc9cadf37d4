"""One backend on one workload, each measurement in a process of its own: threads, compiled code and peak memory do not mix."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TypeVar

import torch
from workloads import Passes, Workload, effects_of

from mipmap_plugin import register_backend
from mipmap_plugin.backends import get_backend
from mipmap_plugin.evaluation.tradeoff.points import Spread

YARDSTICK = "gsplat-twins"
register_backend(YARDSTICK, "gsplat_twins:GsplatTwins")

# Slow backends on large scenes: no run begins after this many seconds, once there are enough for a median.
BUDGET_S = 60.0
FEWEST_RUNS = 3

Result = TypeVar("Result")


@dataclass(frozen=True)
class Timing:
    cpu_ms: Spread  # of the process: with one thread, what it costs even on a busy machine
    wall_ms: Spread
    runs: int

    @classmethod
    def of(cls, runs: list[tuple[float, float]]) -> Timing:
        cpu, wall = zip(*runs, strict=True)
        return cls(Spread.of(list(cpu)), Spread.of(list(wall)), len(runs))


@dataclass(frozen=True)
class Speed:
    """One thread."""

    forward: Timing  # raw parameters -> image, without a graph
    forward_backward: Timing  # raw parameters -> image -> gradients of all of them
    extra_mib: float  # peak of a forward and backward pass over what the process held before


@dataclass(frozen=True)
class Scaling:
    """Forward and backward on one thread, on two, and in two processes of one thread side by side, in turn."""

    one: Timing
    two: Timing
    wall_ratio: Spread  # one over two, run by run
    machine_ratio: Spread  # twice one over both processes: what two processors gave just then


def job_of(backend: str, file: Path) -> Passes:
    render, work = get_backend(backend).render, Workload.load(file)
    raw = {name: tensor.requires_grad_() for name, tensor in work.raw.items()}
    return Passes(raw, work.weights, lambda gaussians: render(gaussians, work.camera, effects_of(gaussians)).image)


def fresh(function: Callable[..., Result], *arguments: object) -> Result:
    """`function(*arguments)` in a new interpreter that ends with it."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def measure_speed(backend: str, file: Path, warm_up: Path, runs: int) -> Speed:
    """`warm_up`: a tiny workload on which imports and compilation are done, so that neither is in the figures."""
    torch.set_num_threads(1)
    job_of(backend, warm_up).forward_backward()
    job = job_of(backend, file)
    before = _peak_mib()
    job.forward_backward()
    extra = round(_peak_mib() - before, 1)
    job.forward()
    forward, both = _in_turn([partial(_timed, job.forward), partial(_timed, job.forward_backward)], runs)
    return Speed(Timing.of(forward), Timing.of(both), extra)


def measure_scaling(backend: str, file: Path, runs: int) -> Scaling:
    job = job_of(backend, file)
    near, far = get_context("spawn").Pipe()
    neighbor = get_context("spawn").Process(target=_neighbor, args=(backend, file, far), daemon=True)
    neighbor.start()
    far.close()  # else nobody would hear of its end

    def beside() -> None:
        near.send("go")
        job.forward_backward()
        near.recv()

    def on(threads: int, call: Callable[[], None]) -> tuple[float, float]:
        torch.set_num_threads(threads)
        call()  # not timed: it finds caches as another number of threads left them
        return _timed(call)

    one, two, both = _in_turn([partial(on, 1, job.forward_backward), partial(on, 2, job.forward_backward), partial(on, 1, beside)], runs)
    neighbor.kill()
    return Scaling(Timing.of(one), Timing.of(two), _ratio(1, one, two), _ratio(2, one, both))


def _neighbor(backend: str, file: Path, far: Connection) -> None:
    """Does the same on one thread, once per request."""
    torch.set_num_threads(1)
    job = job_of(backend, file)
    while far.recv():
        job.forward_backward()
        far.send("done")


def _ratio(work: int, one: list[tuple[float, float]], other: list[tuple[float, float]]) -> Spread:
    """How many times faster than `one` the `other` did `work` times as much, by the wall clock."""
    return Spread.of([round(work * a[1] / b[1], 3) for a, b in zip(one, other, strict=True)])


def _in_turn(timed: list[Callable[[], tuple[float, float]]], runs: int) -> list[list[tuple[float, float]]]:
    """What each timed call took, run by run. In turn, so that a busy spell of the machine meets all alike."""
    times: list[list[tuple[float, float]]] = [[] for _ in timed]
    began = time.perf_counter()
    for done in range(runs):
        if done >= FEWEST_RUNS and time.perf_counter() - began > BUDGET_S:
            break
        for call, spent in zip(timed, times, strict=True):
            spent.append(call())
    return times


def _timed(call: Callable[[], None]) -> tuple[float, float]:
    """Milliseconds of CPU and wall."""
    cpu, wall = time.process_time(), time.perf_counter()
    call()
    return round(1000 * (time.process_time() - cpu), 3), round(1000 * (time.perf_counter() - wall), 3)


def _peak_mib() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10  # bytes there, KiB elsewhere
