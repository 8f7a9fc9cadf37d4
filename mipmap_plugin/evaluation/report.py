"""Rows as text: a table for people, records for scripts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from mipmap_plugin.evaluation.evaluate import Row


def table(rows: Sequence[Row]) -> str:
    """A Markdown table, which is legible in a terminal too."""
    head = ["scale", "what", "adapted on", "PSNR dB", "SSIM", "adapt s", "ms/view", "splats"]
    body = [
        [f"x{row.scale:g}", row.name, row.adapted_on, f"{row.psnr_db:.2f}", "-" if row.ssim is None else f"{row.ssim:.4f}",
         f"{row.adapt_seconds:.1f}", f"{row.ms_per_view:.0f}", f"{row.gaussians:,}"]
        for row in rows
    ]  # fmt: skip
    return markdown(head, body)


def markdown(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Columns padded to one width each."""
    widths = [max(len(line[i]) for line in [head, *body]) for i in range(len(head))]
    lines = [head, ["-" * width for width in widths], *body]
    return "\n".join("| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in lines)


def records(rows: Sequence[Row]) -> list[dict]:
    return [asdict(row) for row in rows]
