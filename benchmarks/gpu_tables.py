"""What was measured on a GPU as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gpu_adaptation import Adaptation

from mipmap_plugin.backends.conformance import Outcome
from mipmap_plugin.evaluation.report import markdown

YARDSTICK = "gsplat"
PAPER = "Mipmap-GS needs 40 s for a zoom-out and 75 s for a zoom-in of bicycle on an A100, its targets not counted (arXiv 2408.06286)."


@dataclass(frozen=True)
class Speed:
    """One backend on one scene."""

    backend: str
    splats: int
    width: int  # px
    height: int  # px
    forward_ms: float
    both_ms: float  # forward and backward
    peak_mib: float  # over what was held before
    forward_bytes: int  # the least that has to move
    both_bytes: int


@dataclass(frozen=True)
class Failure:
    """What was not measured, and why."""

    backend: str
    what: str
    reason: str


def speed_table(rows: Sequence[Speed], bandwidth: float) -> str:
    """`bandwidth`: bytes a second of a copy within the device's memory."""
    yardsticks = {(row.splats, row.width, row.height): row for row in rows if row.backend == YARDSTICK}
    head = ["splats", "px", "backend", "forward, ms", "fwd+bwd, ms", f"x {YARDSTICK}", "GB/s", "of a copy's", "peak, MiB"]
    body = []
    for row in rows:
        other = yardsticks.get((row.splats, row.width, row.height))
        times = f"{other.forward_ms / row.forward_ms:.2f} / {other.both_ms / row.both_ms:.2f}" if other else "-"
        moved = row.both_bytes / row.both_ms * 1000
        place = [f"{row.splats:,}", f"{row.width} x {row.height}", row.backend]
        figures = [f"{row.forward_ms:.2f}", f"{row.both_ms:.2f}", times, f"{moved / 1e9:.0f}", f"{moved / bandwidth:.1%}", f"{row.peak_mib:.0f}"]
        body.append(place + figures)
    return markdown(head, body)


def conformance_table(checked: Mapping[str, Sequence[Outcome]]) -> str:
    """Empty where nothing was checked."""
    body = []
    for name, outcomes in checked.items():
        drawn = [outcome for outcome in outcomes if not outcome.skipped]
        failed = [outcome.case for outcome in drawn if not outcome.passed]
        body.append([name, f"{len(drawn) - len(failed)} of {len(drawn)}", str(len(outcomes) - len(drawn)), ", ".join(failed) or "-"])
    return markdown(["backend", "hard cases right", "not served", "wrong"], body) if body else ""


def adaptation_table(rows: Sequence[Adaptation]) -> str:
    """Empty where nothing was adapted."""
    head = ["base", "zoom", "backend", "seconds", "steps", "dB", "on a processor", "peak, MiB", "ended by"]
    body = [
        [row.base, f"x{row.scale:g}", row.backend, f"{row.seconds:.1f}", str(row.steps), f"{row.psnr_db:.2f}",
         "-" if row.processor_db is None else f"{row.processor_db:.2f}",
         "-" if row.peak_mib is None else f"{row.peak_mib:.0f}", row.ended_by]
        for row in rows
    ]  # fmt: skip
    return f"{markdown(head, body)}\n\n{PAPER}" if body else ""


def report(
    known: Mapping[str, object], bandwidth: float, rows: Sequence[Speed], failures: Sequence[Failure], adapted: Sequence[Adaptation], checked: str
) -> str:
    """Everything as one page."""
    machine = ", ".join(f"{name} {value}" for name, value in known.items() if name != "device")
    lines = [f"# {known['device']}", f"{machine}. A copy moves {bandwidth / 1e9:.0f} GB/s, read and written."]
    if rows:
        lines.append(f"From raw parameters to the image, and back to all of them. x {YARDSTICK}: how many times faster, forward / both. GB/s: only "
                     "what has to move at least, forward and backward.")  # fmt: skip
        lines.append(speed_table(rows, bandwidth))
    lines += [checked, adaptation_table(adapted)]
    lines += [f"Not measured: {' '.join(filter(None, [failure.backend, failure.what]))}: {failure.reason}" for failure in failures]
    return "\n\n".join(filter(None, lines))
