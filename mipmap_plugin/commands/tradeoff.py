"""`mipmap-plugin tradeoff`."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import tyro

from mipmap_plugin.commands.common import tell, wrap
from mipmap_plugin.commands.types import Background, Checkpoint, Scales, ScreenFilter, each_once
from mipmap_plugin.recipes import recipe as make_config


def tradeoff(
    checkpoint: Checkpoint,
    scale: Scales,
    output: Path,
    images: Path | None = None,
    recipe: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    viewer: str | None = None,
    steps: tyro.conf.UseAppendAction[tuple[int, ...]] = (),
    backend: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    supersampling: tyro.conf.UseAppendAction[tuple[int, ...]] = (),
    renderers: bool = True,
    repeats: int = 3,
    views: int | None = None,
    background: Background | None = None,
    screen_filter: ScreenFilter | None = None,
    threads: int | None = None,
    seed: int = 0,
    picture: bool = True,
    overwrite: bool = False,
    json: bool = False,
) -> None:
    """Measure what accuracy costs: dB against seconds to adapt, and against milliseconds a frame.

    Writes tradeoff.json, tradeoff.csv and tradeoff.png. No view that is judged on is adapted to, and clocks stand while it is judged.

    Args:
        checkpoint: A PLY or a model folder.
        scale: Target over base, such as 1/8 or 4. May be given several times.
        output: The folder for the results.
        images: Folder of the scene with real images (protocol P3). Without it the base itself is the truth; every axis and table says which.
        recipe: default, thorough, instant, paper, or one that is registered; default and paper, if none is given.
        viewer: What files are adapted for, and draws them and the base: spark, playcanvas (or supersplat), ...
        steps: Optimizer steps at most, one run for each; what each recipe says, if none is given.
        backend: What to adapt and render with; auto, if none is given.
        supersampling: N for N x N samples a pixel, finer than the base's pixels left out; 2, 4 and 8, if none is given.
        renderers: Also draw the first adapted model with other cut-offs, tiles and float types, by the reference backend.
        repeats: Runs of each, with a seed of their own; the median and the whole range are shown.
        views: Views to judge on, at most.
        background: Of the scene; by default what the checkpoint says, else black.
        screen_filter: What it was trained with, where its files do not say: mip for a fused file of Mip-Splatting, for example.
        threads: Processor threads at most; by default as many as torch finds. The result does not depend on it.
        seed: Of the first repeat.
        picture: Draw tradeoff.png, which needs the extra `plot`.
        overwrite: Replace results that exist.
        json: Print JSON instead of tables.
    """
    from mipmap_plugin.evaluation.tradeoff.files import Folder, facts, refuse, table
    from mipmap_plugin.evaluation.tradeoff.points import Plan
    from mipmap_plugin.evaluation.tradeoff.run import run
    from mipmap_plugin.scenes import load_scene

    refuse(output, picture, overwrite)
    plan = Plan(recipe or ("default", "paper"), steps, backend or ("auto",), supersampling or (2, 4, 8), renderers, repeats, seed, viewer)
    model, scene = wrap(checkpoint, None, background, "auto", screen_filter, threads), None if images is None else load_scene(images)
    model.target(viewer)
    for name, each in product(plan.recipes, scale):
        make_config(name, each)
    found = run(model, scene, each_once(scale), plan, views, Folder(output, picture, overwrite))
    tell(facts(found, complete=True), json) if json else print("\n\n".join(table(each) for each in found))
