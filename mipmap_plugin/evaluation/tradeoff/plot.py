"""Plots of a tradeoff: dB against seconds to adapt and against milliseconds per frame, with the Pareto front and its knee."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mipmap_plugin.adaptation.plot import figure_class
from mipmap_plugin.evaluation.tradeoff.front import Cost, Tradeoff, files, frames, knee, milliseconds, seconds
from mipmap_plugin.evaluation.tradeoff.points import Point, Spread
from mipmap_plugin.formats.atomic import new_file

# Markers by the kind of a point; colors are by its name, and the same in both plots.
MARKS = {"base": "X", "filter": "o", "supersampling": "s", "adapted": "D", "renderer": "."}

# Seconds below which the axis is linear, so that 0 is on it.
BRIEF = 0.1

TITLE_WIDTH = 95  # letters

OTHERWISE = "; or leave them out with --no-picture"


def draw(path: Path, tradeoffs: Sequence[Tradeoff], overwrite: bool) -> None:
    """Write a PNG: a row for each scale, with the seconds on the left and the frames on the right.

    Raises OutputExists, OutputError, and SettingsError without matplotlib.
    """
    figure = figure_class(OTHERWISE)(figsize=(15, 5.4 * len(tradeoffs)), layout="constrained")
    for (left, right), each in zip(figure.subplots(len(tradeoffs), 2, squeeze=False, sharey="row"), tradeoffs, strict=True):
        colors = _colors(each.points)
        _seconds(left, each, colors)
        _frames(right, each, colors)
        right.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=8, frameon=False)
    with new_file(path, overwrite) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def _seconds(axes: Any, each: Tradeoff, colors: dict[str, Any]) -> None:
    """Plot dB against seconds to adapt; what needs no adapting but a special renderer is a horizontal line."""
    for point in each.points:
        if point.kind in ("filter", "supersampling"):
            axes.axhline(point.psnr_db.median, color=colors[point.name], linestyle=":", linewidth=1)
    for name in dict.fromkeys(point.name for point in files(each.points)):
        run = sorted((point for point in files(each.points) if point.name == name), key=seconds)
        for backend in dict.fromkeys(point.backend for point in run):
            part = [point for point in run if point.backend == backend]
            axes.plot([seconds(p) for p in part], [p.psnr_db.median for p in part], color=colors[name], linewidth=1, alpha=0.6)
            for point in part:
                _mark(axes, point, point.adapt_seconds, colors[name], None)
    axes.set_xscale("symlog", linthresh=BRIEF, linscale=0.3)
    axes.set_xlim(left=0)
    axes.set_xlabel("seconds to adapt (dotted: nothing to adapt, but only in a renderer that has it)")
    axes.set_ylabel(each.truth, fontsize=8)
    _title(axes, each, 0)
    _front(axes, each.fronts()[0], seconds)


def _frames(axes: Any, each: Tradeoff, colors: dict[str, Any]) -> None:
    for point in frames(each.points):
        assert point.ms_per_frame is not None  # that is what `frames` are
        _mark(axes, point, point.ms_per_frame, colors[point.name], f"{point.name}, {point.backend}: {point.psnr_db.median:.1f} dB")
    axes.set_xscale("log")
    axes.set_xlabel("milliseconds a frame")
    _title(axes, each, 1)
    _front(axes, each.fronts()[1], milliseconds)


def _title(axes: Any, each: Tradeoff, nth: int) -> None:
    axes.set_title(textwrap.fill(f"x{each.scale:g}: {each.sentences()[nth]}", TITLE_WIDTH), fontsize=9)


def _mark(axes: Any, point: Point, cost: Spread, color: Any, label: str | None) -> None:
    across, up = ([[s.median - s.low], [s.high - s.median]] for s in (cost, point.psnr_db))
    axes.errorbar(cost.median, point.psnr_db.median, up, across, fmt=MARKS[point.kind], color=color, markersize=6, capsize=2, label=label)


def _front(axes: Any, best: Sequence[Point], cost: Cost) -> None:
    axes.step([cost(p) for p in best], [p.psnr_db.median for p in best], where="post", color="black", linewidth=1.2, zorder=0)
    if (found := knee(best, cost)) is not None:
        axes.plot(found.cost, found.point.psnr_db.median, marker="*", markersize=17, color="none", markeredgecolor="black")
    axes.grid(alpha=0.25)


def _colors(points: Sequence[Point]) -> dict[str, Any]:
    """One of twenty colors for each name."""
    from matplotlib import colormaps

    names = list(dict.fromkeys(point.name for point in points))
    return {name: colormaps["tab20"](number % 20) for number, name in enumerate(names)}
