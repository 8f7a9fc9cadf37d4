"""Captures that are no objects on a white table: how good every way to show them is, on views that nothing was adapted to.

    python benchmarks/unbounded.py DATA
    python benchmarks/unbounded.py DATA --only bird_272 --scale 0.25 --views 4

DATA holds `checkpoints/` and `images/bird`. Views are held out of the cameras, one of so many; where a checkpoint came without cameras, new
views of an orbit are judged. Without photographs the truth is the base's own image, shrunk: by averaging (N x N samples a pixel) and by
Pillow's bicubic. A zoom-in is shrunk and compared with the base. Writes unbounded/<capture>_x<scale>.json for each, and
unbounded.md from all of them. One to ten minutes a file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from rows import joined, write_page, write_rows
from torch import Tensor

from mipmap_plugin import Camera, wrap_model
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.upsamplers import register_upsampler
from mipmap_plugin.adaptation.views.policy import choose_views
from mipmap_plugin.camera import evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.evaluation.evaluate import Evaluator, Row, adapted_row
from mipmap_plugin.evaluation.judged import JudgedView
from mipmap_plugin.evaluation.measure import RESIZED, RenderView, adapt_alone, baselines, resized_base, views_seen, warm_up
from mipmap_plugin.evaluation.protocols import PROTOCOLS, Protocol
from mipmap_plugin.evaluation.report import table
from mipmap_plugin.evaluation.tradeoff.truth import EVALUATION_SEED
from mipmap_plugin.formats.images import read_image
from mipmap_plugin.wrap import Wrapped

INTRO = """# Captures

Made by `python benchmarks/unbounded.py DATA`, judged on views that nothing was adapted to: those held out of the cameras, one of so many as the
name says (of bird_272 one of 8, on which the base was not trained either), or 24 new views of an orbit where the checkpoint came without
cameras (of yashica a fifth with pixels half as large). The protocol says by what: *N x N samples*, the base's own image averaged; *base, bicubic*,
the same shrunk by Pillow's bicubic (a zoom-in is shrunk itself and compared with the base's image as it is); P3, photographs. What is the truth
itself has no row. Of flowers at x2 the base's cameras are half as large, and Lanczos takes a network's place. One thread of a shared machine.

Compare no SSIM of `instant`, nor of `default` of bird_272, flowers_r8_every_2 and flowers_r8_every_8, with that of other rows, but of yashica: these
are of an earlier version, whose SSIM left a border of 5 px out. Their seconds are of a busier machine, too.
"""

LANCZOS = dict(upsampler="lanczos as a network")

# New views of an orbit: as many as it takes for their mean to follow the scene. dB of one view lie up to 20 from those of another, and means of
# six up to 2 from each other.
ORBIT_VIEWS = 24

# By what the base's own image is shrunk; floats, for 8 bits end at 59 dB.
AVERAGED = Protocol("N x N samples", "area", eight_bit=False)
BICUBIC = Protocol("base, bicubic", "pil-bicubic", eight_bit=False)


@dataclass(frozen=True)
class Capture:
    """A checkpoint, the views of it that are held out, and the scales that it is shown at."""

    checkpoint: str  # below checkpoints/
    scales: tuple[float, ...]
    every: int | None = None  # one camera of so many is held out; None: it came without cameras
    photographs: str | None = None  # below images/, named as the cameras are
    share: float = 1.0  # of the cameras' size that is the base's
    screen_filter: str | None = None  # that the base was trained with, where its file does not say
    network: bool = False  # Lanczos enlarges the views of a zoom-in


CAPTURES = {
    "flowers_r8_every_2": Capture("flowers_r8", (1 / 4, 1 / 8), every=2),
    "flowers_r8_every_8": Capture("flowers_r8", (1 / 4, 1 / 8), every=8),
    "flowers_r8_every_24": Capture("flowers_r8", (2.0,), every=24, share=0.5, network=True),
    "yashica-t4": Capture("yashica-t4/yashica-t4-top8192.ply", (1 / 4,)),
    "vanilla_iter7000": Capture("vanilla_iter7000", (1 / 4,)),
    "donut_mip_fused": Capture("donut_mip_fused/fused.ply", (1 / 4,), screen_filter="mip"),
    "bird_272": Capture("captures/bird_272", (1 / 2, 1 / 4, 1 / 8, 2.0), every=8, photographs="bird"),
}


@dataclass(frozen=True)
class BaseView:
    """A camera, and the base's own image as its truth."""

    camera: Camera
    image: Tensor

    def truth(self, scale: float, protocol: Protocol) -> Tensor:
        return resized_base(self.image, self.camera.zoomed(min(scale, 1.0)).size, shrink_by=protocol.shrink_by)


class BaseEvaluator(Evaluator):
    """Judges by the base's own images: a zoom-in is shrunk to their size."""

    def row(self, name: str, scale: float, show: RenderView, **facts: Any) -> Row:
        def no_larger(camera: Camera) -> Tensor:
            return resize(show(camera).clamp(0, 1), camera.zoomed(min(scale, 1.0)).size, self.protocol.shrink_by)

        return super().row(name, scale, no_larger, **facts)


def split(base: Wrapped, capture: Capture) -> tuple[list[Camera], list[Camera]]:
    """The views to judge, and the cameras that are left to adapt to; none: an orbit is generated."""
    if capture.every is None:
        return choose_views([], base.viewpoints, AdaptConfig(seed=EVALUATION_SEED, extra_views=ORBIT_VIEWS))[0], []
    cameras = sorted((replace(camera.zoomed(capture.share), split="train", zoom=1.0) for camera in base.cameras), key=lambda camera: camera.name)
    return cameras[:: capture.every], [camera for number, camera in enumerate(cameras) if number % capture.every]


def judges(base: Wrapped, capture: Capture, name: str, scale: float, cameras: Sequence[Camera], data: Path) -> list[Evaluator]:
    with torch.no_grad():
        views = [BaseView(camera, base.render(camera).image.clamp(0, 1)) for camera in cameras]
    found: list[Evaluator] = [BaseEvaluator(views, protocol, scene=name) for protocol in ((AVERAGED, BICUBIC) if scale < 1 else (BICUBIC,))]
    if capture.photographs:
        files = [data / "images" / capture.photographs / f"{camera.name}.jpg" for camera in cameras]
        photographs = [JudgedView(camera, read_image(file, base.background), file) for camera, file in zip(cameras, files, strict=True)]
        found.insert(0, Evaluator(photographs, PROTOCOLS["P3"], scene=name))
    return found


def free_rows(base: Wrapped, judge: Evaluator, scale: float) -> list[Row]:
    """Everything that needs no adapting, but what is the truth itself."""
    finest = math.ceil(1 / scale)
    found = baselines(base, scale, judge.protocol.shrink_by, filters=("scaled", "window"), samples=sorted({2, finest}) if scale < 1 else ())
    truth = {AVERAGED: (RESIZED, f"supersampling, {finest} x {finest}"), BICUBIC: (RESIZED,)}.get(judge.protocol, ())
    return [judge.row(baseline.name, scale, baseline.render, gaussians=baseline.gaussians) for baseline in found if baseline.name not in truth]


def recipes(capture: Capture, scale: float) -> dict[str, dict[str, Any]]:
    """The settings of each row."""
    enlarged = LANCZOS if capture.network else {}
    rows: dict[str, dict[str, Any]] = {"instant": dict(recipe="instant"), "default": enlarged}
    if scale < 1 or enlarged:  # else it does what `default` does
        rows["thorough"] = dict(enlarged, recipe="thorough")
    if enlarged:
        rows["thorough, not on trial"] = dict(enlarged, recipe="thorough", densify_on_trial=False)
    return rows


def rows_of(name: str, scale: float, data: Path, most: int | None, only: Sequence[str]) -> list[Row]:
    """`only`: the recipes to measure, and nothing else; none of them: all, and what needs no adapting."""
    capture = CAPTURES[name]
    base = wrap_model(data / "checkpoints" / capture.checkpoint, screen_filter=capture.screen_filter)
    judged, others = split(base, capture)
    judged = evenly(judged, most or len(judged))
    judged_by = judges(base, capture, name, scale, judged, data)
    rows = [[] if only else free_rows(base, judge, scale) for judge in judged_by]
    warm_up(base, scale, others)
    settings_of = {recipe: settings for recipe, settings in recipes(capture, scale).items() if not only or recipe in only}
    for recipe, settings in settings_of.items():
        adapted = adapt_alone(base, scale, cameras=others or None, **settings)
        assert not views_seen(judged, adapted.adapted_to), f"{name}: views that are judged were adapted to"
        for judge, beside in zip(judged_by, rows, strict=True):
            beside.append(adapted_row(recipe, adapted, judge))
            print(table(beside[-1:]), flush=True)
    return [row for each in rows for row in each]


def main(
    data: tyro.conf.Positional[Path],
    output: Path = Path("benchmarks/results"),
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    scale: tyro.conf.UseAppendAction[tuple[float, ...]] = (),
    recipe: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    views: int | None = None,
) -> None:
    """Measure, and write the tables.

    Args:
        data: The folder with checkpoints/ and images/.
        output: Where the results go; those that were measured before are replaced.
        only: Which captures, by name; all by default.
        scale: Which scales; all of a capture by default.
        recipe: Measure these alone, and keep all other rows.
        views: How many of the held-out views are judged, at most; all by default.
    """
    if unknown := set(only) - CAPTURES.keys():
        raise SystemExit(f"there is no capture {', '.join(sorted(unknown))}; known are {', '.join(CAPTURES)}")
    if unknown := set(recipe) - {known for capture in CAPTURES.values() for each in capture.scales for known in recipes(capture, each)}:
        raise SystemExit(f"no capture has a row {', '.join(sorted(unknown))}")
    torch.set_num_threads(1)
    register_upsampler(LANCZOS["upsampler"], lambda image, size: resize(image, size, "lanczos"), replace=True)
    for name in only or CAPTURES:
        for each in scale or CAPTURES[name].scales:
            file, rows = output / "unbounded" / f"{name}_x{each:g}.json", rows_of(name, each, data, views, recipe)
            write_rows(file, joined(file, Row, rows, lambda row: (row.protocol, row.name)) if recipe else rows)
    write_page(output / "unbounded.md", INTRO, output.glob("unbounded/*.json"))


if __name__ == "__main__":
    tyro.cli(main)
