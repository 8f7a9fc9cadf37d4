"""What captures gain whose cameras are not given: adapted with their cameras and from their splats alone.

    python benchmarks/lone.py DATA
    python benchmarks/lone.py DATA --only flowers_r8 --scale 0.25

DATA holds `checkpoints/`. The truth is the base's own image, averaged to the new size, at every eighth of its cameras; the others are those that are
given. Prints a Markdown table and writes lone.md and lone.json; rows that are not measured again are kept. Ten minutes.
"""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch
import tyro
from captures import Views
from rows import write_table

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.curve import decibel
from mipmap_plugin.camera import evenly
from mipmap_plugin.evaluation.measure import adapt_alone
from mipmap_plugin.models import detect

SCENES = {"flowers_r8": "flowers_r8", "bird_272": "captures/bird_272"}
SCALES, EVERY, JUDGED = (1 / 2, 1 / 4, 1 / 8), 8, 16
HEAD = ["capture", "zoom", "as it is", "without its cameras", "with them", "least change of a view, without", "with", "views, without"]
INTRO = """# Without cameras

Made by `python benchmarks/lone.py DATA`: captures whose PLY was adapted by `default`, by itself and with the cameras that it came with but for every
eighth, from which it is judged: mean PSNR (dB) against the base's own image, averaged. *Least change*: the least that a view changes, in dB.
*Views*: what was adapted to without cameras.
"""


@dataclass(frozen=True)
class Row:
    """One capture at one scale."""

    capture: str
    scale: float
    psnrs_db: list[float]  # of the base as it is, and adapted without its cameras and with them
    least_db: list[float]  # the least change of a view, without and with
    views: str

    def cells(self) -> list[str]:
        return [self.capture, f"x{self.scale:g}", *(f"{db:.1f}" for db in self.psnrs_db), *(f"{db:+.1f}" for db in self.least_db), self.views]


def measure(folder: Path, name: str, scale: float) -> Row:
    whole = wrap_model(folder, threads=1)
    judged = whole.cameras[::EVERY]
    given = [camera for number, camera in enumerate(whole.cameras) if number % EVERY]
    views = Views(whole, evenly(judged, JUDGED), scale)
    with tempfile.TemporaryDirectory() as alone:
        file = Path(shutil.copy(detect(folder).path, alone))
        bases = [wrap_model(file, cameras=cameras, background=whole.background, threads=1) for cameras in (None, given)]
        lone, with_cameras = [adapt_alone(base, scale) for base in bases]
    found = [views.errors(lambda camera: whole.render(camera.zoomed(scale), scale).image)]
    found += [views.errors(lambda camera, adapted=adapted: adapted.render(camera.zoomed(scale)).image) for adapted in (lone, with_cameras)]
    psnrs = [[decibel(error) for error in errors] for errors in found]
    least = [min(after - before for before, after in zip(psnrs[0], each, strict=True)) for each in psnrs[1:]]
    return Row(name, scale, [fmean(each) for each in psnrs], least, lone.report.views)


def main(
    data: tyro.conf.Positional[Path],
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    scale: tyro.conf.UseAppendAction[tuple[float, ...]] = (),
    output: Path = Path("benchmarks/results"),
) -> None:
    """Measure, print the table and write it.

    Args:
        data: The folder with checkpoints/.
        only: Which captures; both by default.
        scale: Which scales; 1/2, 1/4 and 1/8 by default.
        output: Where lone.md and lone.json go.
    """
    torch.set_num_threads(1)
    rows: list[Row] = []
    for name in only or SCENES:
        for each in scale or SCALES:
            rows.append(measure(data / "checkpoints" / SCENES[name], name, each))
            print(*rows[-1].cells(), sep="  ", flush=True)
    write_table(output, "lone", INTRO, HEAD, rows, lambda row: (list(SCENES).index(row.capture), -row.scale))


if __name__ == "__main__":
    tyro.cli(main)
