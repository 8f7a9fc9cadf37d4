"""What real viewers show of a base, of files adapted for them, and of a rival's: screenshots against photographs (protocol P3).

    python benchmarks/viewers.py DATA
    python benchmarks/viewers.py DATA --only lego_200 --scale 0.25 --leave-out viewer

Needs what tests/browser/README.md installs, the rival too. DATA is that of real_bases.py. Writes viewers/<base>.json for each base, and
viewers.md and viewers.png from all in that folder. Files and viewers that are not measured again keep their rows.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean

import torch
import tyro
from bases import photographs_of
from PIL import Image, ImageDraw
from rows import earlier, joined

from mipmap_plugin import wrap_model
from mipmap_plugin.evaluation.judged import JudgedView, photographed_views
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.evaluation.protocols import PROTOCOLS
from mipmap_plugin.evaluation.report import markdown
from mipmap_plugin.formats.atomic import write_json
from mipmap_plugin.formats.images import write_image
from mipmap_plugin.formats.ply import read_header
from mipmap_plugin.wrap import Wrapped

BROWSER = Path(__file__).parents[1] / "tests" / "browser"
sys.path.append(str(BROWSER))

from browser import VIEWERS, Browser, Page  # noqa: E402

BASES = ("lego_200", "chair_400")
SCALES = (1.0, 1 / 2, 1 / 4, 1 / 8)
PROTOCOL = PROTOCOLS["P3"]

# Every third of 25 test views: a view takes a second, and there are hundreds of rows.
VIEWS = slice(0, 24, 3)

# The picture's base, scale, view and viewers, and how many px high each of its parts is shown.
SHOWN = ("lego_200", 1 / 4, 4)
SHOWN_IN = ("spark", "playcanvas", "gaussian-splats-3d", "three")
HEIGHT = 200

INTRO = """# What real viewers show

Made by `python benchmarks/viewers.py DATA`: pictures of the viewers themselves, in Chromium with software WebGL and WebGPU and with exact cameras,
against photographs (protocol P3); dB, mean of 8 test views. *base*: as it is. *classic*: adapted for classic dilation of 0.3 px². *viewer*: adapted
for the viewer that shows it. *portable*: one file for all of them. *splat-transform*: the base decimated by version 3.7.0 to the count of the
viewer's file, uniformly or adaptively. In brackets the splats, thousands.
"""


@dataclass(frozen=True)
class Row:
    """One file of one base at one scale in one viewer."""

    base: str
    scale: float
    viewer: str
    file: str  # of FILES
    splats: int
    psnr_db: float


@dataclass(frozen=True)
class Work:
    """The inputs of the files."""

    base: Wrapped
    scale: float
    folder: Path

    def adapted(self, name: str, **settings: str) -> Path:
        saved = self.folder / name
        if not saved.exists():
            self.base.adapt(self.scale, **settings).save(saved)
        return next(saved.rglob("*.ply"))


def decimated(how: str) -> Callable[[Work, str], Path | None]:
    """A rival's file with as many splats as the one for the viewer; none at x1, where those are about as many as the base's."""

    def file(work: Work, viewer: str) -> Path | None:
        made = work.folder / f"{how}_{viewer}.ply"
        if work.scale != 1 and not made.exists():
            tool, count = BROWSER / "node_modules" / ".bin" / "splat-transform", read_header(work.adapted(viewer, viewer=viewer)).vertex.count
            source = str(work.base.model.source)
            subprocess.run(["node", str(tool), "-q", "-g", "cpu", source, f"--{how}", str(count), str(made)], check=True)
        return made if work.scale != 1 else None

    return file


FILES: dict[str, Callable[[Work, str], Path | None]] = {
    "base": lambda work, viewer: work.base.model.source,
    "classic": lambda work, viewer: None if work.scale == 1 else work.adapted("classic"),  # at x1 the base is that file
    "viewer": lambda work, viewer: work.adapted(viewer, viewer=viewer),
    "portable": lambda work, viewer: work.adapted("portable", viewer="portable"),
    "splat-transform": decimated("decimate"),
    "splat-transform-adaptive": decimated("decimate-adaptive"),
}


def main(
    data: tyro.conf.Positional[Path],
    output: Path = Path("benchmarks/results"),
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    scale: tyro.conf.UseAppendAction[tuple[float, ...]] = (),
    viewer: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    leave_out: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
) -> None:
    """Measure, and write the tables and the picture.

    Args:
        data: The folder with checkpoints/ and images/.
        output: Where the results go; rows that were measured before are replaced.
        only: Which bases; all by default.
        scale: Which scales; all by default.
        viewer: Which viewers, by their names in tests/browser/browser.py; all by default.
        leave_out: Which files are not measured: base, classic, viewer, ...
    """
    torch.set_num_threads(1)
    files = [name for name in FILES if name not in leave_out]
    pictures = output / "viewers"
    pictures.mkdir(parents=True, exist_ok=True)
    for base in only or BASES:
        wrapped = wrap_model(data / "checkpoints" / "bases" / base)
        views = photographed_views(wrapped, wrapped.place(photographs_of(data, base)))[VIEWS]
        for at in scale or SCALES:
            with tempfile.TemporaryDirectory() as folder, Browser() as browser:
                work = Work(wrapped, at, Path(folder))
                rows = [row for name in viewer or VIEWERS for row in rows_of_viewer(browser, work, base, name, files, views, pictures)]
            keep(pictures / f"{base}.json", rows)
    measured = [row for file in sorted(pictures.glob("*.json"), reverse=True) for row in earlier(file, Row)]
    (output / "viewers.md").write_text(page(measured))
    if drawn := mosaic(pictures):
        drawn.save(output / "viewers.png")


def rows_of_viewer(
    browser: Browser, work: Work, base: str, viewer: str, files: Sequence[str], views: Sequence[JudgedView], pictures: Path
) -> list[Row]:
    """Rows of every file in one viewer; the screenshots for the figure are written too."""
    rows = []
    truths = [view.truth(work.scale, PROTOCOL) for view in views]
    for name in files:
        path = FILES[name](work, viewer)
        if path is None:
            continue
        images = screenshots(browser.open(viewer, path), work, views)
        quality = fmean(psnr(image, truth) for image, truth in zip(images, truths, strict=True))
        rows.append(Row(base, work.scale, viewer, name, read_header(path).vertex.count, quality))
        print(rows[-1], flush=True)
        if (base, work.scale) == SHOWN[:2] and viewer in SHOWN_IN:
            write_image(pictures / f"{viewer}_{name}.png", images[SHOWN[2]], overwrite=True)
            write_image(pictures / "truth.png", truths[SHOWN[2]], overwrite=True)
    return rows


def screenshots(opened: Page, work: Work, views: Sequence[JudgedView]) -> list[torch.Tensor]:
    pictures = opened.draw([view.camera.zoomed(work.scale) for view in views], work.base.background)
    return [torch.from_numpy(picture) for picture in pictures]


def keep(file: Path, rows: Sequence[Row]) -> None:
    """Write the rows, beside those of an earlier run that were not measured again."""
    latest = joined(file, Row, rows, lambda row: (row.scale, row.viewer, row.file))
    ranks = {name: rank for rank, name in enumerate((*VIEWERS, *FILES))}
    ordered = sorted(latest, key=lambda row: (-row.scale, ranks[row.viewer], ranks[row.file]))
    write_json(file, [asdict(row) for row in ordered], overwrite=True)


def page(rows: Sequence[Row]) -> str:
    """A table for each base: a line for each scale and viewer, a column for each file."""
    parts = [INTRO]
    for base in dict.fromkeys(row.base for row in rows):
        cells = {(row.scale, row.viewer, row.file): row for row in rows if row.base == base}
        files = [name for name in FILES if any(key[2] == name for key in cells)]
        lines = dict.fromkeys(key[:2] for key in cells)
        body = [[f"x{scale:g}", viewer, *(cell(cells.get((scale, viewer, name))) for name in files)] for scale, viewer in lines]
        parts.append(f"## {base}\n\n{markdown(['scale', 'in', *files], body)}\n")
    return "\n".join(parts)


def cell(row: Row | None) -> str:
    return "–" if row is None else f"{row.psnr_db:.1f} ({row.splats / 1000:.1f})"


def mosaic(pictures: Path) -> Image.Image | None:
    """A row for each viewer that is shown: the truth, then every file; None where the picture's base was not measured."""
    screenshots = {viewer: {name: pictures / f"{viewer}_{name}.png" for name in FILES} for viewer in SHOWN_IN}
    viewers = [viewer for viewer, files in screenshots.items() if any(path.exists() for path in files.values())]
    names = [name for name in FILES if any(screenshots[viewer][name].exists() for viewer in viewers)]
    if not viewers:
        return None
    gap, margin = 10, 20
    sheet = Image.new("RGB", ((HEIGHT + gap) * (len(names) + 1), (HEIGHT + gap + margin) * len(viewers)), "white")
    pen = ImageDraw.Draw(sheet)
    for row, viewer in enumerate(viewers):
        for column, (title, path) in enumerate([("photograph", pictures / "truth.png"), *((name, screenshots[viewer][name]) for name in names)]):
            corner = (column * (HEIGHT + gap), row * (HEIGHT + gap + margin))
            pen.text((corner[0] + 4, corner[1] + 4), f"{viewer}: {title}" if column else title, fill="black")
            if path.exists():
                sheet.paste(enlarged(path), (corner[0], corner[1] + margin))
    return sheet


def enlarged(picture: Path) -> Image.Image:
    """Pixel by pixel, as a screen shows it."""
    with Image.open(picture) as image:
        return image.resize((round(image.width * HEIGHT / image.height), HEIGHT), Image.Resampling.NEAREST)


if __name__ == "__main__":
    tyro.cli(main)
