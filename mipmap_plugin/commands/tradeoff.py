"""`mipmap-plugin tradeoff`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from mipmap_plugin.commands.common import print_json, scene, starting, without_none, wrap
from mipmap_plugin.commands.outputs import folder_of_several
from mipmap_plugin.commands.pages import look_at, tradeoff_page_path, write_tradeoff_page
from mipmap_plugin.commands.resuming import resumable
from mipmap_plugin.commands.types import Background, Cameras, Checkpoint, Scales, ScreenFilter, Threads, Up, Viewer, unique_scales
from mipmap_plugin.commands.voice import say
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.recipes import recipe as make_config

if TYPE_CHECKING:
    from mipmap_plugin.evaluation.tradeoff.files import Folder
    from mipmap_plugin.evaluation.tradeoff.front import Tradeoff
    from mipmap_plugin.evaluation.tradeoff.points import Plan
    from mipmap_plugin.wrap import Wrapped


def tradeoff(
    checkpoint: Checkpoint,
    scale: Scales,
    output: Path,
    images: Path | None = None,
    recipe: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    viewer: Viewer | None = None,
    steps: tyro.conf.UseAppendAction[tuple[int, ...]] = (),
    backend: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    supersampling: tyro.conf.UseAppendAction[tuple[int, ...]] = (),
    renderers: bool = True,
    repeats: int = 3,
    views: int | None = None,
    cameras: Cameras = None,
    up: Up = None,
    background: Background = None,
    screen_filter: ScreenFilter = None,
    threads: Threads = None,
    seed: int = 0,
    picture: bool = True,
    report: bool = False,
    overwrite: bool = False,
    json: bool = False,
) -> None:
    """Measure accuracy against time: dB against seconds to adapt, and against milliseconds per frame.

    Writes tradeoff.json, tradeoff.csv and tradeoff.png. Models are evaluated on views that they were not adapted to, outside the time counted.

    Args:
        checkpoint: A PLY, .spz, .sog, .splat or .glb, or a model folder.
        scale: Target focal length over base focal length, such as 1/8 or 4. Required; may be given several times.
        output: The folder for the results.
        images: Folder of the scene with real images (protocol P3). Without it the base itself is the truth; every axis and table says which.
        recipe: default, thorough (more steps and views), instant (closed form only), paper (published method), or others; default: default, paper.
        viewer: The viewer that files are adapted for, and that they and the base are rendered as: spark, playcanvas (or supersplat), ...
        steps: Maximum number of optimizer steps, of recipes that take any. May be given several times, for a run each; by default that of the recipe.
        backend: Backend to adapt and render with. May be given several times; by default auto.
        supersampling: N for N x N samples per pixel; more than the base's own pixels are skipped. May be given several times; by default 2, 4, 8.
        renderers: Also render the first adapted model with other thresholds, tiles and float types, by the reference backend.
        repeats: Number of runs, each with its own seed; the median and the whole range are reported.
        views: Maximum number of views to evaluate on.
        seed: Seed of the first repeat.
        picture: Draw tradeoff.png, which needs the extra plot.
        report: Also write report.html, a page whose fronts tell each point under the pointer.
        overwrite: Replace results that exist.
        json: Print JSON instead of tables.
    """
    with starting():
        from mipmap_plugin.evaluation.tradeoff.files import KEPT
        from mipmap_plugin.evaluation.tradeoff.points import Plan
        from mipmap_plugin.evaluation.tradeoff.run import run

    folder, page = _outputs(output, picture, report, overwrite)
    plan = Plan(recipe or ("default", "paper"), steps, backend or ("auto",), supersampling or (2, 4, 8), renderers, repeats, seed, viewer)
    base = Base(checkpoint, cameras, background, screen_filter=screen_filter, up=up)
    model, photographs = wrap(base, threads), scene(base, images) if images else None
    _check(model, plan, scale)
    with resumable(output / KEPT, "cell"):
        tradeoffs = run(model, photographs, unique_scales(scale), plan, views, _with_page(folder, page, checkpoint, model))
    _print(tradeoffs, folder, page, json)


def _outputs(output: Path, picture: bool, report: bool, overwrite: bool) -> tuple[Folder, Path | None]:
    """The folder for the results, and the page if one is asked for. Raises what writing them would raise."""
    from mipmap_plugin.evaluation.tradeoff.files import Folder, refuse

    refuse(folder := Folder(folder_of_several(output, (".json", ".csv", ".png", ".html")), picture, overwrite))
    return folder, tradeoff_page_path(output, overwrite) if report else None


def _with_page(folder: Folder, page: Path | None, checkpoint: Path, model: Wrapped) -> Folder:
    return folder if page is None else replace(folder, page=partial(write_tradeoff_page, page, checkpoint, model, folder.overwrite))


def _check(model: Wrapped, plan: Plan, scales: Sequence[float]) -> None:
    """Raise the errors of a viewer, of recipes and of settings before any work."""
    model.target(plan.viewer)
    seeds = {plan.seed, plan.seed + plan.repeats - 1}
    for name, factor, steps, seed in product(plan.recipes, scales, plan.steps or (None,), seeds):
        make_config(name, factor, **without_none(seed=seed, steps=steps))


def _print(tradeoffs: Sequence[Tradeoff], folder: Folder, page: Path | None, json: bool) -> None:
    from mipmap_plugin.evaluation.tradeoff.files import facts, table

    if json:
        return print_json(facts(tradeoffs, complete=True))
    say("\n\n".join(table(tradeoff) for tradeoff in tradeoffs))
    say(f"written: {', '.join(str(file) for file in folder.files)}")
    if page:
        say(look_at(page))
