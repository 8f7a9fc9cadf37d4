"""The backends of this machine as a table: what each lacks, or how it conforms."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from tqdm import tqdm

from mipmap_plugin.backends import get_backend, note_of, survey
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.backends.conformance import CASES, MORE, Outcome, check_backend
from mipmap_plugin.errors import BackendUnavailable
from mipmap_plugin.evaluation.report import markdown


@dataclass(frozen=True)
class Listed:
    """One backend, and why it cannot do the usual work of one device; empty when it can."""

    name: str
    device: str
    reasons: tuple[str, ...]
    note: str = ""  # what is to be known of it besides


def listing() -> list[Listed]:
    """Every known backend, asked for what adapting a 3DGS checkpoint needs on the devices that are here."""
    needs = [Needs(device, torch.float32, gradients=True, sh_degree=3, screen_filter="classic") for device in _devices()]
    return [Listed(name, need.device, tuple(reasons), note_of(name)) for need in needs for name, reasons in survey(need).items()]


def check(name: str, *, full: bool = False) -> list[Outcome]:
    """The conformance suite's outcome for each hard case, on the first device that the backend serves; `full`: for random ones too.

    Raises SettingsError for an unknown backend, BackendUnavailable for one that serves none here.
    """
    backend = get_backend(name)
    cases = {**CASES, **MORE} if full else CASES
    with _one_thread():
        for device in _devices():
            shown = tqdm(cases.items(), disable=None, desc=f"checking {name} on {device}", unit="case")
            outcomes = [outcome for case, build in shown for outcome in check_backend(backend, {case: build}, device=device)]
            if not all(outcome.skipped for outcome in outcomes):
                return outcomes
    raise BackendUnavailable(f"backend {name!r} cannot be checked here: {outcomes[0].message}")


@contextmanager
def _one_thread() -> Iterator[None]:
    """Images this small cost torch four times as much to share out among two threads as to compute in one."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def listing_table(rows: Sequence[Listed]) -> str:
    body = [[row.name, row.device, f"no: {'; '.join(row.reasons)}" if row.reasons else "yes", row.note] for row in rows]
    return markdown(["backend", "device", "adapts 3DGS?", "note"], body)


def _devices() -> list[str]:
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


def check_table(rows: Sequence[Outcome]) -> str:
    def verdict(row: Outcome) -> str:
        return "skipped: " + row.message if row.skipped else "pass" if row.passed else "FAIL: " + row.message

    body = [[row.case, f"{row.max_error:.1e}", "yes" if row.finite else "NO", verdict(row)] for row in rows]
    return markdown(["case", "max error", "finite", "result"], body)
