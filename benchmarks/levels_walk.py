"""A walk: a camera that walks backwards at a fixed focal length, while a streaming viewer chooses a level for each chunk by its distance.

    python benchmarks/levels_walk.py DATA --ladders DIR
    python benchmarks/levels_walk.py DATA --ladders DIR --only flowers_r8

Ladders that are not in DIR yet are made there: by distance, and by zoom, whose switches PlayCanvas's rule follows as closely as it can. The rival is
splat-transform's --decimate to the splats of each of our levels, at our distances; it is left out where splat-transform is not found. Everything is
drawn by our renderer as the viewer draws. Writes levels_walk/<base>_<viewer>.json, and levels_walk.md from all in that folder.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
import tyro
from levels import decimated, ladder_of
from torch import Tensor
from tqdm import tqdm

from mipmap_plugin import load_model, wrap_model
from mipmap_plugin.adaptation.views.farther import backed, foreground
from mipmap_plugin.camera import Camera
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.evaluation.report import markdown
from mipmap_plugin.formats.atomic import write_json
from mipmap_plugin.formats.splat_transform import TOOL, find_tool
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.levels.distance.ladder import scene_of
from mipmap_plugin.levels.distance.mixture import Mixture
from mipmap_plugin.levels.distance.rule import DistanceRule
from mipmap_plugin.levels.distance.scene import DistanceScene
from mipmap_plugin.levels.distance.walks import WalkTruth
from mipmap_plugin.levels.manifest import CANVAS, MANIFEST
from mipmap_plugin.levels.request import LadderRequest
from mipmap_plugin.levels.streamed import distances, progression
from mipmap_plugin.models.places import REPORT
from mipmap_plugin.scenes.trajectories import jittered
from mipmap_plugin.wrap import Wrapped

BASES = ("flowers_r8", "bases/lego_200")
VIEWER = "playcanvas"

# Frames of a walk, until what was nearest is COARSEST as large, in equal ratios; and walks, from random views that nothing was adapted to.
FRAMES, COARSEST = 13, 1 / 8
WALKS, SEED = 2, 271_828

# Samples of the truth per pixel along each side.
SAMPLES = 3

INTRO = f"""# A walk over levels

Made by `python benchmarks/levels_walk.py DATA --ladders DIR`: a camera that walks backwards, {WALKS} walks from random views that nothing was adapted
to, {FRAMES} frames each, until what was nearest is 1/{1 / COARSEST:g} as large. A level is chosen for each chunk by its distance, as PlayCanvas does.
Drawn by our renderer as the viewer draws; dB against the base with {SAMPLES} x {SAMPLES} samples a pixel, its dilation as large in the world as
where the walk begins. *By distance*: each splat at the scale at which its distance shows it. *By zoom*: one scale for the scene, with the distances
closest to its switches. *Base*: alone. *{TOOL}*: its `--decimate` to the splats of each level by distance, at the same distances.
*Flicker*: RMS of the change between neighboring frames that the truth does not have, in 8-bit levels. *Splats*: shown in a frame, on average.
*Switches*: of chunks, in a walk; *least likeness*: PSNR between the pictures of one frame before and after all its switches.
"""


@dataclass(frozen=True)
class Frame:
    """One frame, mean over the walks."""

    scale: float  # of what is nearest
    psnr_db: float
    flicker: float | None  # 8-bit levels; None for the first
    splats: float
    switches: float  # chunks that changed their level since the frame before
    likeness_db: float | None  # PSNR between the pictures with the chunks' levels of the frame before and of this; None where nothing switched


@dataclass(frozen=True)
class Film:
    """A way to show the scene."""

    name: str
    splats: list[int]  # of its files
    frames: list[Frame]


@dataclass(frozen=True, eq=False)
class Walk:
    """The cameras of one walk and what they should see."""

    cameras: list[Camera]
    truths: list[Tensor]


def walks(scene: DistanceScene) -> list[Walk]:
    truth = WalkTruth((scene.splats, scene.backend, scene.base.effects()), scene.views, {}, SAMPLES)
    found = []
    for view in jittered(scene.views, WALKS, torch.Generator().manual_seed(SEED)):
        depth = foreground(view, scene.splats.means, scene.target.near_plane)
        cameras = [backed(view, depth * (1 / scale - 1)) for scale in scales()]
        found.append(Walk(cameras, [truth.make(camera, view) for camera in tqdm(cameras, desc="truth", disable=None)]))
    return found


def scales() -> list[float]:
    return [COARSEST ** (number / (FRAMES - 1)) for number in range(FRAMES)]


@torch.no_grad()
def film(scene: DistanceScene, name: str, mixture: Mixture, walked: Sequence[Walk]) -> Film:
    """Measure every frame of all walks."""
    columns = [_walked(scene, mixture, walk) for walk in walked]
    frames = []
    for scale, rows in zip(scales(), zip(*columns, strict=True), strict=True):
        quality, flicker, splats, switches, likeness = ([value for value in column if value is not None] for column in zip(*rows, strict=True))
        frames.append(Frame(scale, fmean(quality), fmean(flicker) if flicker else None, fmean(splats), fmean(switches), min(likeness, default=None)))
    return Film(name, [len(level) for level in mixture.levels], frames)


def _walked(scene: DistanceScene, mixture: Mixture, walk: Walk) -> list[tuple[float | None, ...]]:
    """PSNR, flicker, splats, switches and likeness of each frame of one walk."""
    rows: list[tuple[float | None, ...]] = []
    wrong_before: Tensor | None = None
    for before, (camera, truth) in zip([None, *walk.cameras], zip(walk.cameras, walk.truths, strict=True), strict=False):
        shown = mixture.splats(camera)
        image = draw(scene, shown, camera)
        wrong = image - truth
        flicker = None if wrong_before is None else 255 * float((wrong - wrong_before).square().mean().sqrt())
        switches = 0 if before is None else int((mixture.shown(camera) != mixture.shown(before)).sum())
        likeness = psnr(draw(scene, mixture.splats(before), camera), image) if before is not None and switches else None
        rows.append((psnr(image, truth), flicker, float(len(shown)), float(switches), likeness))
        wrong_before = wrong
    return rows


def draw(scene: DistanceScene, splats: Gaussians, camera: Camera) -> Tensor:
    return scene.backend.render(splats, camera, scene.target).image.clamp(0, 1)


def mixture_of(scene: DistanceScene, folder: Path) -> Mixture:
    """The levels of a ladder and PlayCanvas's rule with the distances that are closest to its switches."""
    manifest = json.loads((folder / MANIFEST).read_text())
    base_distance, multiplier = progression(distances(manifest, CANVAS), 2.0)
    rule = DistanceRule(base_distance * math.tan(math.pi / 8) / (CANVAS / 2), multiplier, len(manifest["levels"]))
    return Mixture.of(rule, scene.chunks, [splats_of(scene, folder / level["file"]) for level in manifest["levels"]])


def splats_of(scene: DistanceScene, file: Path) -> Gaussians:
    return load_model(file).gaussians(scene.base.any_camera()).detach()


def mixtures(scene: DistanceScene, base: Wrapped, ladders: Path, name: str, folder: Path) -> dict[str, Mixture]:
    """All ways to show the scene."""
    ours, by_zoom = (
        mixture_of(scene, ladder_of(base, VIEWER, ladders / f"{name}_{VIEWER}_{by}", coarsest=COARSEST, by=by)) for by in ("distance", "zoom")
    )
    alone = Mixture.of(DistanceRule(1.0, 2.0, 1), scene.chunks, [scene.splats])
    found = {"by distance": ours, "by zoom": by_zoom, "base": alone}
    source, tool = base.model.source, find_tool()
    if tool is None or source is None:
        print(f"{TOOL} is not found, so that its levels are left out", file=sys.stderr)
        return found
    counts = [len(level) for level in ours.levels[1:]]
    by_count = {count: splats_of(scene, decimated(tool, source, count, folder / f"rival_{count}.ply")) for count in dict.fromkeys(counts)}
    return {**found, TOOL: Mixture.of(ours.rule, scene.chunks, [scene.splats, *(by_count[count] for count in counts)])}


def page(results: Sequence[dict[str, Any]]) -> str:
    return "\n".join([INTRO, *(section(each) for each in results)])


def section(result: dict[str, Any]) -> str:
    head = ["", "worst, dB", "mean, dB", "first, dB", "x1/2", "x1/4", "last", "flicker, mean", "worst", "splats", "switches", "least likeness, dB"]
    facts = f"{result['chunks']} chunks of at most {result['extent']} world units; levels of {result['counts']} splats, {result['steps']} steps each"
    said = f"{facts} at most. {result['note']}".strip()
    return f"## {result['base']} in {result['viewer']}\n\n{said}\n\n{markdown(head, [row(film) for film in result['films']])}\n"


def row(film: dict[str, Any]) -> list[str]:
    frames = film["frames"]
    quality, flicker, likeness = ([frame[key] for frame in frames if frame[key] is not None] for key in ("psnr_db", "flicker", "likeness_db"))
    at = [min(frames, key=lambda frame: abs(math.log(frame["scale"] / scale)))["psnr_db"] for scale in (1, 1 / 2, 1 / 4, COARSEST)]
    splats, switches = fmean(frame["splats"] for frame in frames), sum(frame["switches"] for frame in frames)
    numbers = [min(quality), fmean(quality), *at]
    least = f"{min(likeness):.1f}" if likeness else "–"
    changes = [f"{fmean(flicker):.2f}", f"{max(flicker):.2f}", f"{splats:,.0f}", f"{switches:.0f}", least]
    return [film["name"], *(f"{number:.1f}" for number in numbers), *changes]


def main(
    data: tyro.conf.Positional[Path],
    ladders: Path,
    output: Path = Path("benchmarks/results"),
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    note: str = "",
) -> None:
    """Measure, and write the tables.

    Args:
        data: The folder with checkpoints/.
        ladders: Folder for the ladders.
        output: Where the results go; those of the same base are replaced.
        only: Which bases; all by default.
        note: What a reader of the page should know about the ladders.
    """
    torch.set_num_threads(1)
    for path in only or BASES:
        base, name = wrap_model(data / "checkpoints" / path, threads=1), Path(path).name
        request = LadderRequest(VIEWER, coarsest=COARSEST)
        scene = scene_of(base, request, request.first_band(base))
        walked = walks(scene)
        with tempfile.TemporaryDirectory() as folder:
            shown = mixtures(scene, base, ladders, name, Path(folder))
            films = [film(scene, each, mixture, walked) for each, mixture in shown.items()]
        report = json.loads((ladders / f"{name}_{VIEWER}_distance" / f"level_1.ply{REPORT}").read_text())
        facts = {
            "base": name, "note": note, "steps": report["settings"]["steps"], "viewer": VIEWER, "chunks": len(scene.chunks), "extent": scene.extent,
            "counts": ", ".join(f"{count:,}" for count in films[0].splats), "films": [asdict(one) for one in films],
        }  # fmt: skip
        write_json(output / "levels_walk" / f"{name}_{VIEWER}.json", facts, overwrite=True)
    results = [json.loads(file.read_text()) for file in sorted((output / "levels_walk").glob("*.json"))]
    (output / "levels_walk.md").write_text(page(results), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)
