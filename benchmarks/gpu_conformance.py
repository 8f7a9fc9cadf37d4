"""The hard cases on a GPU, shared among several processes: what they cost is the processor's, and compiling."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import torch

from mipmap_plugin.backends import get_backend
from mipmap_plugin.backends.conformance import CASES, Outcome, check_backend
from mipmap_plugin.backends.conformance.checks import check_steps, check_views

SHARE = 6  # cases at a time
ROUNDS = 4  # at most so many sets of processes, if kernels break them

# What only some backends have: its name in them, and what checks it, with the case of this name.
OPTIONAL = {"views": ("render_views", check_views), "steps": ("stepper", check_steps)}
USUAL = "sh-degree-3"
ALL = (*CASES, *OPTIONAL)

# After an error of CUDA's a process can launch nothing more.
BROKEN = ("CUDA error", "CUDA driver error")


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


def check_all(backends: Sequence[str], device: str, processes: int, cases: Sequence[str] = ALL) -> Iterator[Checked]:
    """Every backend on every case, all backends at once, each in processes of its own. A case that breaks its process fails alone."""
    each = max(1, processes // len(backends))
    rounds = {name: Round(name, device, each, cases) for name in backends}
    for name, first in rounds.items():
        outcomes = first.outcomes()
        for _ in range(1, ROUNDS):
            if left := [case for case in cases if case not in outcomes]:
                outcomes |= Round(name, device, each, left).outcomes()
        missing = {case: Outcome(case, float("nan"), False, False, "its process broke") for case in cases if case not in outcomes}
        yield Checked.of(name, list((outcomes | missing).values()))


class Round:
    """Processes that check cases until all are done, or all of them are broken."""

    def __init__(self, name: str, device: str, processes: int, cases: Sequence[str]) -> None:
        self._pool = ProcessPoolExecutor(processes, get_context("spawn"), torch.set_num_threads, (1,))
        cases = sorted(cases, key=_kind)
        shares = [cases[first : first + SHARE] for first in range(0, len(cases), SHARE)]
        self._jobs: list[Future[list[Outcome]]] = [self._pool.submit(_outcomes, name, device, share) for share in shares]

    def outcomes(self) -> dict[str, Outcome]:
        """By case, as far as there are any."""
        with self._pool:
            return {outcome.case: outcome for job in self._jobs if not job.exception() for outcome in job.result()}


def _kind(case: str) -> tuple[int, str, bool]:
    """Cases of one kind need the same kernels: where they lie side by side, each process compiles others. Those that take longest come first."""
    built = CASES[USUAL if case in OPTIONAL else case]()
    return -built.effects.sh_degree, built.effects.screen_filter, built.gaussians.covariances is not None


_broken = False  # whether this process is


def _outcomes(name: str, device: str, cases: Sequence[str]) -> list[Outcome]:
    """The outcomes of these cases, up to one that breaks this process."""
    global _broken
    found = []
    for case in cases:
        if _broken:
            break
        found.append(_outcome(name, device, case))
        _broken = any(sign in found[-1].message for sign in BROKEN)
    return found


def _outcome(name: str, device: str, case: str) -> Outcome:
    backend = get_backend(name)
    if case not in OPTIONAL:
        return check_backend(backend, {case: CASES[case]}, device=device)[0]
    part, check = OPTIONAL[case]
    if not hasattr(backend, part):
        return Outcome(case, float("nan"), True, True, f"it has no {part}", skipped=True)
    try:
        return check(backend, CASES[USUAL], device=device)
    except Exception as error:  # as `check_backend`
        return Outcome(case, float("nan"), False, False, f"{type(error).__name__}: {error}")
