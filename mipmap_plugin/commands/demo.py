"""`mipmap-plugin demo`."""

from __future__ import annotations

from pathlib import Path

import tyro

from mipmap_plugin.commands.common import starting
from mipmap_plugin.commands.types import Scale, Viewer, unique_scales
from mipmap_plugin.commands.voice import detail, say


def demo(
    output: Path = Path("mipmap-demo"),
    scale: tyro.conf.UseAppendAction[tuple[Scale, ...]] = (),
    viewer: Viewer | None = None,
    report: bool = True,
    overwrite: bool = False,
) -> None:
    """Adapt the embedded scene at x1/8, x1/4 and x4, write before/after pictures and a page, and print what changed.

    Args:
        scale: Scales, instead of 1/8, 1/4 and 4; may be given several times.
        viewer: The viewer that the files are made for: spark, playcanvas (or supersplat), ...
        output: The folder for the pictures.
        report: Also write report.html, a page that shows the zooms, the viewers and the curves.
        overwrite: Replace files that exist there.
    """
    with starting():
        from mipmap_plugin.demo.run import run_demo

    say(run_demo(output, unique_scales(scale or (0.125, 0.25, 4.0)), viewer, report=report, overwrite=overwrite, detail=detail))
