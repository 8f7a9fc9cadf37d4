"""A dolly: a camera that zooms out continuously from x1 to x1/16, over a ladder of levels, over rivals' and over single files.

    python benchmarks/levels.py DATA --ladders DIR
    python benchmarks/levels.py DATA --ladders DIR --only bases/lego_200 --viewer spark

Ladders that are not in DIR yet are made there (minutes each). The rival is splat-transform's --decimate, to the splats of each of our levels, in the
same file format; its levels are shown at the same zooms. It is left out where splat-transform is not found. Where there are test photographs, frames
are compared with those too. Writes levels/<base>_<viewer>.json and .png, a strip of frames, and levels.md and levels.png from all in that folder.
--no-measure makes the strips only.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
import tyro
from levels_page import draw, page, strip
from levels_photographs import against, photograph
from torch import Tensor
from tqdm import tqdm

from mipmap_plugin import load_model, load_scene, wrap_model
from mipmap_plugin.adaptation.adapted import render_model
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.camera import Camera
from mipmap_plugin.evaluation.judged import JudgedView, photographed_views
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.atomic import write_json
from mipmap_plugin.formats.splat_transform import TOOL, find_tool
from mipmap_plugin.levels.manifest import MANIFEST
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.models.places import state_path
from mipmap_plugin.scenes.trajectories import jittered
from mipmap_plugin.wrap import Wrapped

BASES = ("bases/lego_200", "bases/chair_400", "flowers_r8")
VIEWERS = ("spark", "playcanvas")

# Frames of the dolly, from x1 to COARSEST in equal ratios, and the test views that it is seen from.
FRAMES, COARSEST = 49, 1 / 16
VIEWS = slice(3, 25, 12)

# A base without test views is seen from as many random ones; the seed is of none that anything was adapted to.
RANDOM_VIEWS, SEED = 2, 271_828

# Zooms of the strip of frames.
STRIP = (1.0, 1 / 2, 1 / 4, 1 / 8, 1 / 16)

# The filter that shrinks the truth, as in protocol P3 and for the pseudo truth.
SHRINK_BY = "pil-bicubic"

# A single file of ours, of the default recipe.
SINGLE = 1 / 4


@dataclass(frozen=True)
class Frame:
    """One frame of one film: what a view shows at a zoom."""

    zoom: float
    psnr_db: float  # mean over the views, against the supersampled base
    flicker: float | None  # 8-bit levels: RMS of the change from the frame before, minus the same change of the truth; None for the first
    photo_db: float | None = None  # mean over the views, against their photographs; None where there are none


@dataclass(frozen=True)
class Film:
    """A way to show the scene during the dolly."""

    name: str
    splats: list[int]  # of its files
    megabytes: float
    frames: list[Frame]


@dataclass(frozen=True)
class Change:
    """A switch of our ladder: what it changes, beside what a zoom of 1 % changes."""

    zoom: float
    step_db: float  # dB of the finer level minus dB of the coarser
    likeness_db: float  # PSNR between both levels' images
    one_percent_db: float  # PSNR between the truth there and at 1 % less zoom


class Dolly:
    """The frames' cameras and their truths."""

    def __init__(self, base: Wrapped, views: Sequence[Camera], photographs: Sequence[JudgedView] = ()) -> None:
        """`photographs`: of all the views, in their order, or none."""
        self.base, self.views = base, views
        self._photographs = dict(zip(views, photographs, strict=bool(photographs)))
        self.zooms = [COARSEST ** (number / (FRAMES - 1)) for number in range(FRAMES)]

    def truth(self, view: Camera, zoom: float, like: float | None = None) -> Tensor:
        """The supersampled base, at least as finely as its training, then shrunk; in a frame as large as that of the zoom `like`."""
        samples = math.ceil(1 / zoom - 1e-9)
        camera = at(view, zoom, like)
        fine = camera.resized(camera.width * samples, camera.height * samples)
        image = self.base.render(fine, zoom * samples, "scaled").image.clamp(0, 1)
        return resize(image, camera.size, SHRINK_BY).clamp(0, 1)

    def truths(self) -> dict[Camera, list[Tensor]]:
        return {view: [self.truth(view, zoom) for zoom in self.zooms] for view in self.views}

    def photo_db(self, images: Mapping[Camera, Sequence[Tensor]]) -> list[float | None]:
        """PSNR (dB) of each frame against the photographs, mean over the views, of the frames of each view."""
        if not self._photographs:
            return [None] * len(self.zooms)
        rows = []
        for view, shot in self._photographs.items():
            wanted = [photograph(shot, at(view, zoom)) for zoom in self.zooms]
            rows.append([against(image, truth, shot.camera, zoom) for image, truth, zoom in zip(images[view], wanted, self.zooms, strict=True)])
        return [fmean(column) for column in zip(*rows, strict=True)]


def at(view: Camera, zoom: float, like: float | None = None) -> Camera:
    """The view at exactly this zoom: its focal length changes continuously, while the frame has an even number of pixels that holds it."""
    width, height = (max(2, 2 * math.ceil(side * (like or zoom) / 2)) for side in (view.width, view.height))
    cx, cy = width / 2 + zoom * (view.cx - view.width / 2), height / 2 + zoom * (view.cy - view.height / 2)
    return replace(view, width=width, height=height, fx=zoom * view.fx, fy=zoom * view.fy, cx=cx, cy=cy)


@dataclass(frozen=True, eq=False)
class Show:
    """Files and the zooms at which they are changed, in one viewer."""

    name: str
    files: Sequence[SplatModel]
    switches: Sequence[float]  # falling zooms, one fewer than files
    megabytes: float

    def file(self, zoom: float) -> SplatModel:
        return self.files[sum(zoom < switch for switch in self.switches)]


def film(dolly: Dolly, show: Show, viewer: str, truths: dict[Camera, list[Tensor]]) -> Film:
    """Measure every frame."""
    quality, flicker, shown = [], [], {}
    for view in dolly.views:
        zooms = tqdm(dolly.zooms, desc=show.name, disable=None)
        shown[view] = images = [drawn(dolly.base, show.file(zoom), viewer, at(view, zoom)) for zoom in zooms]
        quality.append([psnr(image, truth) for image, truth in zip(images, truths[view], strict=True)])
        wrong = [image - truth for image, truth in zip(images, truths[view], strict=True)]
        flicker.append([255 * float((middle(before, after) - after).square().mean().sqrt()) for before, after in pairwise(wrong)])
    means = [fmean(each) for each in zip(*quality, strict=True)]
    changes = [None, *(fmean(each) for each in zip(*flicker, strict=True))]
    frames = [Frame(*each) for each in zip(dolly.zooms, means, changes, dolly.photo_db(shown), strict=True)]
    return Film(show.name, [len(file.parameters()["means"]) for file in show.files], show.megabytes, frames)


def middle(image: Tensor, like: Tensor) -> Tensor:
    """The middle of an image, as large as another."""
    top, left = ((image.shape[axis] - like.shape[axis]) // 2 for axis in (0, 1))
    return image[top : top + like.shape[0], left : left + like.shape[1]]


def drawn(base: Wrapped, model: SplatModel, viewer: str, camera: Camera) -> Tensor:
    """What a viewer shows of a file."""
    backend, _ = base.backend(viewer=viewer)
    return render_model(model, backend, camera, base.target(viewer)).image.clamp(0, 1)


def frames(dolly: Dolly, shown: Sequence[Show], viewer: str) -> dict[str, list[Tensor]]:
    """What the first view shows at the strip's zooms: the truth, then each way to show the scene."""
    view = dolly.views[0]
    pictures = {"supersampled base": [dolly.truth(view, zoom) for zoom in STRIP]}
    return pictures | {show.name: [drawn(dolly.base, show.file(zoom), viewer, at(view, zoom)) for zoom in STRIP] for show in shown}


def changes(dolly: Dolly, ours: Show, viewer: str) -> list[Change]:
    """What each switch changes."""
    found = []
    for (finer, coarser), zoom in zip(pairwise(ours.files), ours.switches, strict=True):
        rows = []
        for view in dolly.views:
            one, other = (drawn(dolly.base, file, viewer, at(view, zoom)) for file in (finer, coarser))
            truth, smaller = dolly.truth(view, zoom), dolly.truth(view, 0.99 * zoom, like=zoom)
            rows.append((psnr(one, truth) - psnr(other, truth), psnr(one, other), psnr(smaller, truth)))
        found.append(Change(zoom, *(fmean(column) for column in zip(*rows, strict=True))))
    return found


def dolly_of(base: Wrapped, images: Path) -> Dolly:
    """The dolly, seen from test views with photographs where the images lie there, else from random views between the base's own."""
    if images.is_dir():
        shots = photographed_views(base, base.place(load_scene(images)))[VIEWS]
        return Dolly(base, [shot.camera for shot in shots], shots)
    return Dolly(base, jittered(base.views(), RANDOM_VIEWS, torch.Generator().manual_seed(SEED)))


def ladder_of(base: Wrapped, viewer: str, folder: Path, **options: Any) -> Path:
    """The ladder in a folder, made there if it is not yet; `options`: of `Wrapped.levels`."""
    if not (folder / MANIFEST).is_file():
        base.levels(viewer, resume=state_path(folder), **options).save(folder)
    return folder


def shows(base: Wrapped, viewer: str, ladder: Path, folder: Path) -> list[Show]:
    """Our ladder, the base alone, one file of ours, and the rival's ladder if it is found."""
    source = base.model.source
    assert source is not None  # since the base was read from a file
    manifest = json.loads((ladder / MANIFEST).read_text())
    levels, switches = [load_model(ladder / level["file"]) for level in manifest["levels"]], [each["zoom"] for each in manifest["switches"]]
    single = base.adapt(SINGLE, viewer=viewer).save(folder / "single.ply")
    found = [
        Show("levels", levels, switches, sum(level["bytes"] for level in manifest["levels"]) / 1e6),
        Show("base", [base.model], [], source.stat().st_size / 1e6),
        Show(f"one file for x{SINGLE:g}", [load_model(single)], [], single.stat().st_size / 1e6),
    ]
    if (tool := find_tool()) is None:
        print(f"{TOOL} is not found, so that its levels are left out", file=sys.stderr)
        return found
    counts = [level["splats"] for level in manifest["levels"][1:]]
    made = {count: decimated(tool, source, count, folder / f"rival_{count}.ply") for count in set(counts)}  # two levels may have as many
    files = [made[count] for count in counts]
    megabytes = sum(file.stat().st_size for file in (source, *files)) / 1e6
    return [*found, Show(TOOL, [base.model, *(load_model(file) for file in files)], switches, megabytes)]


def decimated(tool: Sequence[str], source: Path, count: int, output: Path, option: str = "--decimate") -> Path:
    """The rival's file of so many splats."""
    subprocess.run([*tool, "--quiet", "--gpu", "cpu", str(source), option, str(count), str(output)], check=True)
    return output


def main(
    data: tyro.conf.Positional[Path],
    ladders: Path,
    output: Path = Path("benchmarks/results"),
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    viewer: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    measure: bool = True,
) -> None:
    """Measure, and write the tables and the plot.

    Args:
        data: The folder with checkpoints/ and images/.
        ladders: Folder for the ladders.
        output: Where the results go; those of the same base and viewer are replaced.
        only: Which bases; all by default.
        viewer: Which viewers; all by default.
        measure: Measure, and not only draw the strips of frames.
    """
    torch.set_num_threads(1)
    for path in only or BASES:
        base, name = wrap_model(data / "checkpoints" / path, threads=1), Path(path).name
        dolly = dolly_of(base, data / "images" / name.split("_")[0])
        truths = dolly.truths() if measure else {}
        for each in viewer or VIEWERS:
            ladder = ladder_of(base, each, ladders / f"{name}_{each}", coarsest=COARSEST)
            with tempfile.TemporaryDirectory() as folder:
                shown = shows(base, each, ladder, Path(folder))
                strip(output / "levels" / f"{name}_{each}.png", frames(dolly, shown, each), STRIP)
                if not measure:
                    continue
                films = [film(dolly, show, each, truths) for show in shown]
            manifest = json.loads((ladder / MANIFEST).read_text())
            facts = {
                "base": name, "viewer": each, "films": [asdict(one) for one in films],
                "changes": [asdict(change) for change in changes(dolly, shown[0], each)],
                "seconds": [level["seconds"] for level in manifest["levels"]], "supersampled_photo_db": dolly.photo_db(truths),
            }  # fmt: skip
            write_json(output / "levels" / f"{name}_{each}.json", facts, overwrite=True)
    results = [json.loads(file.read_text()) for file in sorted((output / "levels").glob("*.json"), reverse=True)]
    if results:
        (output / "levels.md").write_text(page(results), encoding="utf-8")
        draw(output / "levels.png", results)


if __name__ == "__main__":
    tyro.cli(main)
