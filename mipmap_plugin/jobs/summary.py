"""What became of many jobs, as a table and as JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from mipmap_plugin.errors import plural
from mipmap_plugin.formats.here import from_here, told_from_here
from mipmap_plugin.jobs.job import Job, Outcome

COLUMNS = ("checkpoint", "scale", "viewer", "outcome", "splats", "dB", "seconds", "file, or what is wrong")

# How many jobs are named that warned of the same: thousands may, where no scene has cameras.
NAMED = 5


def in_order(outcomes: Iterable[Outcome], jobs: Sequence[Job]) -> list[Outcome]:
    """The outcomes in the order of the jobs; those of jobs that were never begun are missing."""
    places = {job.target: place for place, job in enumerate(jobs)}
    return sorted(outcomes, key=lambda outcome: places[outcome.job.target])


def table(outcomes: Sequence[Outcome]) -> str:
    """A row for each job, in columns."""
    rows = [COLUMNS, *(_row(outcome) for outcome in outcomes)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)


def _row(outcome: Outcome) -> tuple[str, ...]:
    job, report = outcome.job, outcome.report
    splats = f"{report['gaussians_before']:,} -> {report['gaussians_after']:,}" if report else ""
    seconds, last = f"{outcome.seconds:.1f}", from_here(outcome.file) if outcome.file else told_from_here(outcome.reason)
    return (from_here(job.base.checkpoint), f"x{job.scale:g}", job.viewer or "", outcome.status, splats, _psnr(report), seconds, last)


def _psnr(report: dict[str, Any]) -> str:
    """dB before (the base as it is) and after (the file, as its format rounds it), as in `Report.gain`; empty where one was not measured."""
    from mipmap_plugin.adaptation.report import AS_IT_IS  # which imports torch

    psnrs, after = report.get("validation") or {}, report.get("written")
    if after is None:
        after = next((psnr for name, psnr in psnrs.items() if str(report.get("returned", "")).startswith(name)), None)
    before = psnrs.get(AS_IT_IS)
    return "" if before is None or after is None else f"{before:.2f} -> {after:.2f}"


def totals(outcomes: Sequence[Outcome], count: int) -> str:
    """How many of `count` jobs became what, in a sentence."""
    statuses = Counter(outcome.status for outcome in outcomes)
    waiting = count - sum(statuses.values())
    parts = [f"{number} {status}" for status, number in statuses.items()] + ([f"{waiting} not begun"] if waiting else [])
    return f"{plural(count, 'job')}: {', '.join(parts) or 'none begun'}"


def warned(outcomes: Iterable[Outcome]) -> list[str]:
    """What jobs warned of, each warning once, after the first of the jobs that gave it."""
    jobs = dict[str, list[str]]()
    for outcome in outcomes:
        for text in outcome.warnings:
            jobs.setdefault(text, []).append(str(outcome.job))
    return [f"{', '.join(of[:NAMED])}{f' and {len(of) - NAMED} more' * (len(of) > NAMED)}: {text}" for text, of in jobs.items()]


def facts(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Each job and its outcome, for JSON; of one that succeeded also its report."""
    return [
        {
            "checkpoint": str(outcome.job.base.checkpoint),
            "scale": outcome.job.scale,
            "viewer": outcome.job.viewer,
            "outcome": outcome.status,
            "file": outcome.file and str(outcome.file),
            "reason": outcome.reason,
            "trace": outcome.trace,
            "warnings": list(outcome.warnings),
            "job_seconds": outcome.seconds,
            "report": outcome.report or None,
        }
        for outcome in outcomes
    ]
