"""`mipmap-plugin evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import tyro

from mipmap_plugin.commands.common import tell, wrap
from mipmap_plugin.commands.types import Background, Checkpoint, Scales, ScreenFilter, each_once
from mipmap_plugin.config import Recipe
from mipmap_plugin.files import refuse_existing, write_json
from mipmap_plugin.scenes import load_scene


def evaluate(
    checkpoint: Checkpoint,
    images: Path,
    scale: Scales,
    recipe: tyro.conf.UseAppendAction[tuple[Recipe, ...]] = (),
    protocol: Literal["P1", "P2", "P3"] = "P3",
    steps: int | None = None,
    background: Background | None = None,
    screen_filter: ScreenFilter | None = None,
    backend: str = "auto",
    seed: int = 0,
    output: Path | None = None,
    overwrite: bool = False,
    json: bool = False,
) -> None:
    """Judge a checkpoint against real images: as it is, with training-free filters, resized, and adapted.

    Args:
        checkpoint: A PLY or a model folder; its cameras tell the base scale.
        images: Folder of the scene (transforms_*.json or COLMAP's sparse/0, and the images).
        scale: Target over base, such as 1/4 or 4; 1 is the base itself. May be given several times.
        recipe: Adapt with this recipe, once on views that are not judged on and once on those that are; may be given several times.
        protocol: How a photograph becomes the truth at another scale: P1 box, truncated; P2, P3 Pillow's bicubic.
        steps: Optimizer steps at most, instead of the recipe's.
        background: Of the scene; by default what the checkpoint says, else black.
        screen_filter: What it was trained with, where its files do not say: mip for a fused file of Mip-Splatting, for example.
        backend: A backend's name; auto takes the fastest that can do it.
        seed: Everything random follows from it.
        output: Also write the rows as JSON to this file.
        overwrite: Replace that file if it exists.
        json: Print JSON instead of a table.
    """
    from mipmap_plugin.evaluation.evaluate import evaluate as rows_of
    from mipmap_plugin.evaluation.report import records, table

    if output:
        refuse_existing(output, overwrite)
    wrapped = wrap(checkpoint, None, background, backend, screen_filter)
    overrides: dict[str, Any] = {"seed": seed} | ({} if steps is None else {"steps": steps})
    rows = rows_of(wrapped, load_scene(images), each_once(scale), recipe, protocol, **overrides)
    if output:
        write_json(output, records(rows), overwrite)
    if json:
        tell(records(rows), json)
    else:
        print(f"{checkpoint}, truth: {protocol} from {images}, real dB over the test views")
        print(table(rows))
