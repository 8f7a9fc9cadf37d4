"""Tables of this machine's backends: which can adapt, and the results of the conformance suite."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import product

import torch

from mipmap_plugin.backends import get_backend, note_of, survey
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.backends.conformance import CASES, MORE, Outcome, check_backend
from mipmap_plugin.backends.conformance.usual_faults import usual_fault
from mipmap_plugin.errors import BackendUnavailable, plural
from mipmap_plugin.evaluation.report import markdown
from mipmap_plugin.process import threads
from mipmap_plugin.progress import Bar

# Reasons that are told beside the table of cases: the most frequent.
REASONS = 5


@dataclass(frozen=True)
class BackendStatus:
    """One backend on one device, and why it cannot adapt a 3DGS checkpoint there; no reasons if it can."""

    name: str
    device: str
    reasons: tuple[str, ...]
    note: str  # the backend's own


def listing() -> list[BackendStatus]:
    """The status of every known backend on every device of this machine."""
    needs = [Needs(device, torch.float32, gradients=True, sh_degree=3, screen_filter="classic") for device in _devices()]
    return [BackendStatus(name, need.device, tuple(reasons), note_of(name)) for need in needs for name, reasons in survey(need).items()]


def check(name: str, *, full: bool = False) -> list[Outcome]:
    """Run the conformance suite on the first device that the backend serves, in float32 if it can; with `full`, including random cases.

    Raises SettingsError for an unknown backend, BackendUnavailable for one that serves no device here.
    """
    backend = get_backend(name)
    cases = {**CASES, **MORE} if full else CASES
    with threads.limited(1, shared=False):  # four times as fast as two for images this small
        for device, dtype in product(_devices(), (torch.float32, torch.float64)):
            progress = Bar(cases.items(), desc=f"checking {name} on {device}", unit="case")
            outcomes = [outcome for case, build in progress for outcome in check_backend(backend, {case: build}, dtype=dtype, device=device)]
            if not all(outcome.skipped for outcome in outcomes):
                return outcomes
    raise BackendUnavailable(f"backend {name!r} cannot be checked here: {outcomes[0].message}")


def likely_fault(name: str) -> str:
    """What seems to be wrong with a backend that was checked, in a sentence (`usual_fault`); "" if nothing usual."""
    for device, dtype in product(_devices(), (torch.float32, torch.float64)):
        with suppress(Exception):  # whatever a third-party backend raises was told case by case
            if fault := usual_fault(get_backend(name), dtype=dtype, device=device):
                return fault
    return ""


def listing_table(rows: Sequence[BackendStatus]) -> str:
    body = [[row.name, row.device, f"no: {'; '.join(row.reasons)}" if row.reasons else "yes", row.note] for row in rows]
    return markdown(["backend", "device", "adapts 3DGS?", "note"], body)


def _devices() -> list[str]:
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


def check_table(rows: Sequence[Outcome]) -> str:
    """How often each reason kept cases from being run, and a Markdown table of those that were, at its end those that failed."""
    ran = sorted((row for row in rows if not row.skipped), key=lambda row: not row.passed)
    body = [[row.case, f"{row.max_error:.1e}", "yes" if row.finite else "NO", "pass" if row.passed else f"FAIL: {row.message}"] for row in ran]
    reasons = Counter(reason for row in rows if row.skipped for reason in row.message.split("; "))
    skipped = [f"skipped, {plural(count, 'time')}: {reason}" for reason, count in reasons.most_common(REASONS)]
    skipped += [f"skipped for {plural(len(reasons) - REASONS, 'more reason')} (--json has all)"] * (len(reasons) > REASONS)
    return "\n".join([*skipped, markdown(["case", "max error", "finite", "result"], body)])
