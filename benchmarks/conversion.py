"""Zoom-ins for viewers that draw otherwise than the training did: with the conversion at x1 before, and without.

    python benchmarks/conversion.py
    python benchmarks/conversion.py DATA --only lego_200 --viewer spark --scale 2

Made-up captures (made_captures.py) are judged as in captures.py, by views that nothing was adapted to, averaged to the size of the base's own image.
With DATA, that of real_bases.py, lego and chair are judged by photographs (protocol P3). Writes conversion.md and conversion.json; rows that are not
measured again are kept. Half an hour; the captures alone take twenty minutes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch
import tyro
from bases import photographs_of
from captures import Views
from made_captures import CAPTURES
from rows import write_table

from mipmap_plugin import Camera, wrap_model
from mipmap_plugin.adaptation.curve import decibel
from mipmap_plugin.camera import evenly
from mipmap_plugin.evaluation.judged import photographed_views
from mipmap_plugin.evaluation.measure import RenderView
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.evaluation.protocols import PROTOCOLS
from mipmap_plugin.wrap import Wrapped

VIEWERS, SCALES = ("spark", "playcanvas"), (2.0, 4.0)
BASES = {"lego_200": "bases/lego_200", "chair_100": "bases/chair_100"}
JUDGED = 8  # views, of those that nothing was adapted to
HEAD = ["scene", "viewer", "zoom", "base", "without", "with", "seconds without", "with"]
INTRO = """# Zoom-ins for other viewers

Made by `python benchmarks/conversion.py DATA`: mean PSNR (dB) of views that nothing was adapted to, drawn as the viewer draws. *base*: as it is.
*without*: `default` with `conversion_steps=0`. *with*: `default`, which first learns at x1 how the viewer draws. Lego and chair against photographs
(protocol P3), all others against the base's own image, to whose size the zoom-in is averaged. One thread of a shared machine.
"""


@dataclass(frozen=True)
class Row:
    """One scene in one viewer at one zoom; dB and seconds."""

    scene: str
    viewer: str
    scale: float
    base: float
    without: float
    with_it: float
    seconds_without: float
    seconds_with: float

    def cells(self) -> list[str]:
        quality = [f"{value:.1f}" for value in (self.base, self.without, self.with_it)]
        return [self.scene, self.viewer, f"x{self.scale:g}", *quality, f"{self.seconds_without:.0f}", f"{self.seconds_with:.0f}"]


def prepared(name: str, data: Path | None) -> tuple[Wrapped, Callable[[float], Callable[[RenderView], float]]]:
    """A base, and what judges it: a zoom -> (what is shown -> dB)."""
    if name in CAPTURES:
        capture = CAPTURES[name]()
        return (base := capture.wrapped()), lambda scale: by_itself(base, capture.held_out[:JUDGED], scale)
    if data is None:
        raise SystemExit(f"{name} needs DATA, or there is no such capture; known are {', '.join((*CAPTURES, *BASES))}")
    base = wrap_model(data / "checkpoints" / BASES[name], threads=1)
    shots = evenly(photographed_views(base, base.place(photographs_of(data, name))), JUDGED)

    def by_photographs(scale: float) -> Callable[[RenderView], float]:
        p3 = PROTOCOLS["P3"]
        truths = [(shot.camera, shot.truth(scale, p3)) for shot in shots]
        return lambda show: fmean(psnr(p3.as_saved(show(camera)), truth) for camera, truth in truths)

    return base, by_photographs


def by_itself(base: Wrapped, cameras: Sequence[Camera], scale: float) -> Callable[[RenderView], float]:
    """What judges a zoom-in by the base's own images."""
    views = Views(base, cameras, scale)
    return lambda show: fmean(map(decibel, views.errors(show)))


def measure(name: str, data: Path | None, viewers: Sequence[str], scales: Sequence[float]) -> list[Row]:
    base, judge_at = prepared(name, data)
    rows = []
    for viewer in viewers:
        for scale in scales:
            judge = judge_at(scale)
            plain, converted = (base.adapt(scale, viewer=viewer, **settings) for settings in ({"conversion_steps": 0}, {}))
            quality = [judge(lambda camera: base.render(camera.zoomed(scale), scale, viewer=viewer).image)]  # noqa: B023
            quality += [judge(lambda camera, of=adapted: of.render(camera.zoomed(scale)).image) for adapted in (plain, converted)]  # noqa: B023
            rows.append(Row(name, viewer, scale, *quality, plain.report.seconds["total"], converted.report.seconds["total"]))
            print(*rows[-1].cells(), sep="  ", flush=True)
    return rows


def main(
    data: tyro.conf.Positional[Path | None] = None,
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    viewer: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    scale: tyro.conf.UseAppendAction[tuple[float, ...]] = (),
    output: Path = Path("benchmarks/results"),
) -> None:
    """Measure, print the table and write it.

    Args:
        data: The folder with checkpoints/ and images/; without it captures alone are measured.
        only: Which scenes; by default all.
        viewer: Which viewers; spark and playcanvas by default.
        scale: Which zooms; 2 and 4 by default.
        output: Where conversion.md and conversion.json go.
    """
    torch.set_num_threads(1)
    names = [*BASES, *CAPTURES]
    rows = [row for name in only or (names if data else CAPTURES) for row in measure(name, data, viewer or VIEWERS, scale or SCALES)]
    write_table(output, "conversion", INTRO, HEAD, rows, lambda row: (names.index(row.scene), row.viewer, row.scale))


if __name__ == "__main__":
    tyro.cli(main)
