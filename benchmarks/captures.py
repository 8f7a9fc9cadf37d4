"""Captures of every kind of camera movement: what adapting does to each view that nothing was adapted to.

    python benchmarks/captures.py
    python benchmarks/captures.py --only board --scale 0.25 --seed 0 --seed 1

Captures are made up (made_captures.py), so that the base's own image, averaged over N x N samples a pixel, is the truth; a zoom-in is averaged
itself and compared with it. Prints a Markdown table and writes captures.md and captures.json; rows that
are not measured again are kept. Three minutes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch
import tyro
from made_captures import CAPTURES, Capture
from rows import write_table
from torch import Tensor

from mipmap_plugin import Camera
from mipmap_plugin.adaptation.curve import decibel
from mipmap_plugin.adaptation.optimization.validation import VISIBLE_ERROR
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.evaluation.measure import RenderView
from mipmap_plugin.wrap import Wrapped

SCALES = (1 / 4, 1 / 8, 2.0)
HEAD = ["capture", "zoom", "seed", "base", "scaled", "2 x 2", "instant", "default", "worst view", "splats", "seconds"]
INTRO = """# Captures of every kind

Made by `python benchmarks/captures.py`: captures of our own making, each with one thing that is hard about its cameras
(`benchmarks/made_captures.py`). Mean PSNR (dB) of views that nothing was adapted to, against the base's own image, averaged; a zoom-in is
averaged itself and compared with it. *2 x 2*: the mean of so many samples a pixel, for a renderer that can. *Worst view*: the least that `default`
changes any view of the base's by, in dB as far as differences can be seen (below two steps of 8 bits, 42 dB, they hardly count). One thread of a
shared machine.
"""


@dataclass(frozen=True)
class Row:
    """One capture at one scale; dB over the views that are held out."""

    capture: str
    scale: float
    seed: int
    psnrs_db: dict[str, float]  # the mean, by what is shown
    least_change_db: float  # of a view, from base to `default`, as far as it is visible
    share: float  # of the splats that is left
    seconds: float
    returned: str

    def cells(self) -> list[str]:
        quality = [f"{value:.1f}" for value in self.psnrs_db.values()]
        facts = [f"{self.least_change_db:+.1f}", f"{self.share:.0%}", f"{self.seconds:.0f}"]
        return [self.capture, f"x{self.scale:g}", str(self.seed), *quality, *facts]


class Views:
    """The held-out views of a capture at one scale, and their truth."""

    def __init__(self, base: Wrapped, cameras: Sequence[Camera], scale: float) -> None:
        self._cameras, self._shown_at = cameras, min(scale, 1.0)
        with torch.no_grad():
            self._truths = [self._shrunk(base.render(camera).image, camera) for camera in cameras]

    def _shrunk(self, image: Tensor, camera: Camera) -> Tensor:
        return resize(image.clamp(0, 1), camera.zoomed(self._shown_at).size, "area")

    @torch.no_grad()
    def errors(self, show: RenderView) -> list[float]:
        """The mean square error of each view."""
        images = [self._shrunk(show(camera), camera) for camera in self._cameras]
        return [float((image - truth).square().mean()) for image, truth in zip(images, self._truths, strict=True)]


def measure(name: str, capture: Capture, scale: float, seed: int) -> Row:
    base = capture.wrapped()
    views = Views(base, capture.held_out, scale)
    adapted = {recipe: base.adapt(scale, recipe=recipe, seed=seed) for recipe in ("instant", "default")}
    errors = {
        "base": views.errors(lambda camera: base.render(camera.zoomed(scale), scale).image),
        "scaled": views.errors(lambda camera: base.render(camera.zoomed(scale), scale, "scaled").image),
        "2 x 2": views.errors(lambda camera: base.render(camera.zoomed(scale), scale, "scaled", 2).image),
    }
    for recipe, result in adapted.items():
        errors[recipe] = views.errors(lambda camera, result=result: result.render(camera.zoomed(scale)).image)
    visible = [[decibel(error + VISIBLE_ERROR) for error in errors[of]] for of in ("base", "default")]
    least = min(after - before for before, after in zip(*visible, strict=True))
    report = adapted["default"].report
    psnrs = {of: fmean(map(decibel, each)) for of, each in errors.items()}
    return Row(name, scale, seed, psnrs, least, report.gaussians_after / report.gaussians_before, report.seconds["total"], report.returned)


def main(
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    scale: tyro.conf.UseAppendAction[tuple[float, ...]] = (),
    seed: tyro.conf.UseAppendAction[tuple[int, ...]] = (),
    output: Path = Path("benchmarks/results"),
) -> None:
    """Measure, print the table and write it.

    Args:
        only: Which captures; all by default.
        scale: Which scales; 1/4, 1/8 and 2 by default.
        seed: The seeds of adapting; 0 by default.
        output: Where captures.md and captures.json go.
    """
    if unknown := set(only) - CAPTURES.keys():
        raise SystemExit(f"there is no capture {', '.join(sorted(unknown))}; known are {', '.join(CAPTURES)}")
    torch.set_num_threads(1)
    rows: list[Row] = []
    for name in only or CAPTURES:
        capture = CAPTURES[name]()
        for each in scale or SCALES:
            rows += [measure(name, capture, each, number) for number in seed or (0,)]
            print(*rows[-1].cells(), rows[-1].returned, sep="  ", flush=True)
    order = lambda row: (list(CAPTURES).index(row.capture), abs(math.log2(row.scale)), row.scale, row.seed)  # noqa: E731
    write_table(output, "captures", INTRO, HEAD, rows, order)


if __name__ == "__main__":
    tyro.cli(main)
