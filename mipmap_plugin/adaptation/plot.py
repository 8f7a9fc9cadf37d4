"""The curve of an adaptation as a figure (extra `plot`)."""

from __future__ import annotations

import io
from typing import Any

from mipmap_plugin.adaptation.report import Report
from mipmap_plugin.errors import SettingsError, install


def figure_class(otherwise: str = "") -> Any:
    """matplotlib's Figure class, which needs no screen. Raises SettingsError without matplotlib; `otherwise`: what else can be done then."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise SettingsError(f"plots need matplotlib; {install('plot')}{otherwise}") from error
    return Figure


def plot(report: Report) -> Any:
    """dB over the seconds of adapting, as a matplotlib Figure that a notebook shows. Raises SettingsError without matplotlib."""

    class Shown(figure_class()):  # type: ignore[misc]  # it has no types without matplotlib
        """A figure that a notebook shows without pyplot."""

        def _repr_png_(self) -> bytes:
            file = io.BytesIO()
            self.savefig(file, format="png", dpi=110)
            return file.getvalue()

    figure = Shown(figsize=(7, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot([point.seconds for point in report.curve], [point.validation_db for point in report.curve], marker="o", markersize=4)
    undone = [point for point in report.curve if point.taken_back]
    axes.plot([point.seconds for point in undone], [point.validation_db for point in undone], "x", color="tab:red")
    if (base := report.psnr_before()) is not None:
        axes.axhline(base, linestyle="--", color="gray", label=f"base, {base:.2f} dB")
        axes.legend(frameon=False)
    axes.set_xlim(left=0)
    axes.set_xlabel("seconds of adapting")
    axes.set_ylabel("dB on validation views")
    axes.set_title(f"x{report.scale:g}{f' for {report.viewer}' if report.viewer else ''}: ended by {report.ended_by}", fontsize=10)
    return figure
