"""The hard cases on a GPU, shared among several processes: what they cost is the processor's, and compiling."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import torch

from mipmap_plugin.backends import get_backend
from mipmap_plugin.backends.conformance import CASES, Outcome, check_backend

SHARE = 6  # cases at a time


@dataclass(frozen=True)
class Checked:
    """What the hard cases showed of one backend."""

    backend: str
    cases: int
    skipped: int
    failed: dict[str, str]  # case -> what is wrong

    @classmethod
    def of(cls, backend: str, outcomes: Sequence[Outcome]) -> Checked:
        failed = {outcome.case: outcome.message for outcome in outcomes if not outcome.passed}
        return cls(backend, len(outcomes), sum(outcome.skipped for outcome in outcomes), failed)


def check_all(backends: Sequence[str], device: str, processes: int, cases: Sequence[str] = tuple(CASES)) -> Iterator[Checked]:
    """Every backend on every case. Each backend has processes of its own: a kernel that fails takes its whole process along."""
    pools = {name: _workers(max(1, processes // len(backends))) for name in backends}
    pending = {name: _submitted(pool, name, device, cases) for name, pool in pools.items()}
    for name, jobs in pending.items():
        yield Checked.of(name, [outcome for share, job in jobs for outcome in _result(share, job)])
        pools[name].shutdown(cancel_futures=True)


def _workers(count: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(count, get_context("spawn"), torch.set_num_threads, (1,))


def _submitted(pool: ProcessPoolExecutor, name: str, device: str, cases: Sequence[str]) -> list[tuple[Sequence[str], Future[list[Outcome]]]]:
    shares = [cases[first : first + SHARE] for first in range(0, len(cases), SHARE)]
    return [(share, pool.submit(_outcomes, name, device, share)) for share in shares]


def _outcomes(name: str, device: str, cases: Sequence[str]) -> list[Outcome]:
    return check_backend(get_backend(name), {case: CASES[case] for case in cases}, device=device)


def _result(share: Sequence[str], job: Future[list[Outcome]]) -> list[Outcome]:
    """The outcomes of a share, all of them failures if its process died."""
    try:
        return job.result()
    except Exception as error:  # a crash in a kernel or a driver
        return [Outcome(case, float("nan"), False, False, f"{type(error).__name__}: {error}") for case in share]
