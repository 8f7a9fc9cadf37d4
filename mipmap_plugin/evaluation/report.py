"""Rows as text: a table for people, records for scripts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from mipmap_plugin.evaluation.evaluate import Row
from mipmap_plugin.evaluation.published import LPIPS_LABEL, Published

WIDEST_REMARK = 40  # characters


def table(rows: Sequence[Row]) -> str:
    """A Markdown table, legible in a terminal too. Scenes, LPIPS and reasons for ending have columns only where there are any."""
    several, label = len({row.scene for row in rows}) > 1, next((row.lpips_label for row in rows if row.lpips_label), "")
    head = ["scene"] * several + ["scale", "protocol", "what", "adapted on", "PSNR dB", "SSIM"] + [label] * bool(label)
    ended = any(row.ended_by for row in rows)
    head += ["adapt s", "ms/view", "splats"] + ["ended by"] * ended
    body = [
        [row.scene] * several
        + [f"x{row.scale:g}", row.protocol, row.name, row.adapted_on, f"{row.psnr_db:.2f}", _digits(row.ssim, 4)]
        + [_digits(row.lpips, 4)] * bool(label)
        + [f"{row.adapt_seconds:.1f}", f"{row.ms_per_view:.0f}", f"{row.gaussians:,}"]
        + [row.ended_by] * ended
        for row in rows
    ]
    return markdown(head, body)


def published_table(rows: Sequence[Published]) -> str:
    head = ["scale", "protocol", "published", "PSNR dB", "SSIM", LPIPS_LABEL, "source"]
    body = [
        [f"x{row.scale:g}", row.protocol, row.method, f"{row.psnr_db:.2f}", _digits(row.ssim, 3), _digits(row.lpips, 3), row.source] for row in rows
    ]
    return markdown(head, body)


def _digits(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def markdown(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A Markdown table with columns of constant width. In the last one, long remarks stick out, or all lines would be as long as the longest."""
    widths = [max(len(line[i]) for line in [head, *body]) for i in range(len(head))]
    widths[-1] = min(widths[-1], WIDEST_REMARK)
    lines = [head, ["-" * width for width in widths], *body]
    return "\n".join("| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in lines)


def records(rows: Sequence[Row]) -> list[dict[str, Any]]:
    return [asdict(row) for row in rows]
