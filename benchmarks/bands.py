"""What SH bands are worth that a zoom-out adds where merging has made room: bases cut down to fewer, as files of phones and of the web are.

    python benchmarks/bands.py DATA
    python benchmarks/bands.py DATA --only chair_400 --scale 0.25

DATA holds `checkpoints/bases/`. The truth is the base's own image, cut down as it is, averaged to the new size, in views that nothing was adapted to.
Prints a Markdown table and writes bands.md and bands.json; rows that are not measured again are kept. A quarter of an hour.
"""

from __future__ import annotations

import time
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
from mipmap_plugin.wrap import Wrapped

BASES, SCALES, DEGREES, JUDGED = ("lego_200", "chair_400"), (1 / 2, 1 / 4, 1 / 8), (0, 1, 2), 12
HEAD = ["base", "cut to degree", "zoom", "splats", "as it is", "same bands", "more bands", "up to", "CPU seconds, same", "more"]
INTRO = """# More SH bands

Made by `python benchmarks/bands.py DATA`: bases whose SH bands were cut down to a degree, mean PSNR (dB) of 12 test views against their own image,
averaged. *Same bands*: `default` with `most_sh_degree=0`. *More bands*: `default`, which adds as many as merging has made room for, *up to* a degree;
no file has more numbers than its base. *Splats*: the part that is left.
"""


@dataclass(frozen=True)
class Row:
    """One base, cut down, at one scale."""

    base: str
    cut_to: int
    scale: float
    share: float  # of the splats that is left
    psnrs_db: list[float]  # of the base as it is, and adapted with the same bands and with more
    reached: int  # the degree
    seconds: list[float]  # of adapting with the same bands, and with more

    def cells(self) -> list[str]:
        psnrs, seconds = [f"{value:.1f}" for value in self.psnrs_db], [f"{value:.1f}" for value in self.seconds]
        return [self.base, str(self.cut_to), f"x{self.scale:g}", f"{self.share:.0%}", *psnrs, str(self.reached), *seconds]


def measure(whole: Wrapped, name: str, degree: int, scale: float) -> Row:
    cameras = [camera for camera in whole.cameras if camera.split == "train"]
    base = wrap_model(whole.model.with_degree(degree), cameras=cameras, background=whole.background, threads=1)
    views = Views(base, evenly([camera for camera in whole.cameras if camera.split == "test"], JUDGED), scale)
    psnrs, seconds = [views.errors(lambda camera: base.render(camera.zoomed(scale), scale).image)], []
    for most in (0, 3):
        began = time.process_time()
        adapted = adapt_alone(base, scale, most_sh_degree=most)
        seconds.append(time.process_time() - began)
        psnrs.append(views.errors(lambda camera, adapted=adapted: adapted.render(camera.zoomed(scale)).image))
    report = adapted.report
    reached, share = adapted.model.gaussians().used_sh_degree(), report.gaussians_after / report.gaussians_before
    return Row(name, degree, scale, share, [fmean(map(decibel, errors)) for errors in psnrs], reached, seconds)


def main(
    data: tyro.conf.Positional[Path],
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    scale: tyro.conf.UseAppendAction[tuple[float, ...]] = (),
    output: Path = Path("benchmarks/results"),
) -> None:
    """Measure, print the table and write it.

    Args:
        data: The folder with checkpoints/bases/.
        only: Which bases; both by default.
        scale: Which scales; 1/2, 1/4 and 1/8 by default.
        output: Where bands.md and bands.json go.
    """
    torch.set_num_threads(1)
    rows: list[Row] = []
    for name in only or BASES:
        whole = wrap_model(data / "checkpoints" / "bases" / name, threads=1)
        for each in scale or SCALES:
            for degree in DEGREES:
                rows.append(measure(whole, name, degree, each))
                print(*rows[-1].cells(), sep="  ", flush=True)
    write_table(output, "bands", INTRO, HEAD, rows, lambda row: (BASES.index(row.base), row.cut_to, -row.scale))


if __name__ == "__main__":
    tyro.cli(main)
