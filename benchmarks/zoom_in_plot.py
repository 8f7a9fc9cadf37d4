"""The picture of `zoom_in.py`: dB against LPIPS, a panel for each base and scale, crispness as lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from mipmap_plugin.adaptation.plot import figure_class
from mipmap_plugin.evaluation.evaluate import Row
from mipmap_plugin.evaluation.measure import BASE

# What a row's name has before its crispness.
BY_CRISPNESS = ", crispness "

# Panels beside one another.
ACROSS = 2


def draw(path: Path, measured: Mapping[str, Sequence[Row]]) -> None:
    """Write a PNG; `measured`: the rows of each base. Raises SettingsError without matplotlib."""
    panels = [(base, scale, list(rows)) for base, every in measured.items() for scale, rows in groupby(every, lambda row: row.scale)]
    lines = -(-len(panels) // ACROSS)
    figure = figure_class()(figsize=(6.5 * ACROSS, 5 * lines), layout="constrained")
    for axes, (base, scale, rows) in zip(figure.subplots(lines, ACROSS, squeeze=False).flat, panels, strict=False):
        _panel(axes, rows)
        axes.set_title(f"{base} at x{scale:g}")
    figure.savefig(path, format="png", dpi=80)


def _panel(axes: Any, rows: Sequence[Row]) -> None:
    """LPIPS to the right is worse; what has better LPIPS than the base lies where it is shaded."""
    base = next(row for row in rows if row.name == BASE)
    for kind in ("closed form", "default"):
        line = [row for row in rows if row.name.startswith(kind + BY_CRISPNESS)]
        axes.plot([row.lpips for row in line], [row.psnr_db for row in line], marker="D", markersize=5, label=f"{kind}, by crispness")
        for row in line:
            axes.annotate(row.name.split(BY_CRISPNESS)[1], (row.lpips, row.psnr_db), xytext=(5, -9), textcoords="offset points", fontsize=7)
    for row in rows:
        if BY_CRISPNESS not in row.name:
            mark = "X" if row is base else "s" if row.name.startswith("enlarged") else "o"
            axes.plot(row.lpips, row.psnr_db, mark, color="black" if row is base else None, label=row.name)
    axes.axvspan(0, base.lpips, color="green", alpha=0.06)
    axes.set_xlim(0, 1.05 * max(row.lpips or 0.0 for row in rows))
    axes.set_xlabel("LPIPS (alex)")
    axes.set_ylabel("dB, P3")
    axes.grid(alpha=0.25)
    axes.legend(fontsize=7, frameon=False)
