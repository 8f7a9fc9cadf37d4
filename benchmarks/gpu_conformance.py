"""The hard cases on a GPU, shared among several processes: what they cost is the processor's, and compiling."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

import torch
from gpu_records import Checked
from gpu_work import BROKEN

from mipmap_plugin.backends import get_backend
from mipmap_plugin.backends.conformance import CASES, Outcome, check_backend
from mipmap_plugin.backends.conformance.checks import check_steps, check_views

SHARE = 6  # cases at a time
ROUNDS = 4  # at most so many sets of processes, if kernels break them

# What only some backends have: its name in them, and what checks it, with the case of this name.
OPTIONAL = {"views": ("render_views", check_views), "steps": ("stepper", check_steps)}
USUAL = "sh-degree-3"
ALL = (*CASES, *OPTIONAL)


def check(name: str, device: str, processes: int, cases: Sequence[str] = ALL) -> Iterator[Checked]:
    """A backend on every case: what is known of it, after each share of them. A case that breaks its process fails alone."""
    known = dict[str, Outcome]()
    for _ in range(ROUNDS):
        if left := [case for case in cases if case not in known]:
            for outcomes in _round(name, device, processes, left):
                known |= {outcome.case: outcome for outcome in outcomes}
                yield Checked.of(name, list(known.values()), len(cases) - len(known))
    if missing := [Outcome(case, float("nan"), False, False, "its process broke") for case in cases if case not in known]:
        yield Checked.of(name, [*known.values(), *missing])


def _round(name: str, device: str, processes: int, cases: Sequence[str]) -> Iterator[list[Outcome]]:
    """The outcomes of shares of the cases, by processes that go on until all are done, or all of them are broken."""
    cases = sorted(cases, key=_kind)
    shares = [cases[first : first + SHARE] for first in range(0, len(cases), SHARE)]
    step = -(-len(shares) // processes)
    shares = [share for first in range(step) for share in shares[first::step]]
    with ProcessPoolExecutor(processes, get_context("spawn"), torch.set_num_threads, (1,)) as pool:
        for job in as_completed([pool.submit(_outcomes, name, device, share) for share in shares]):
            if not job.exception():
                yield job.result()


def _kind(case: str) -> tuple[int, str, bool]:
    """Cases of one kind need the same kernels: where they lie side by side, processes that begin far from one another compile others."""
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
