"""`mipmap-plugin inspect`."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mipmap_plugin.commands.common import print_facts, summary
from mipmap_plugin.commands.types import Checkpoint, ScreenFilter
from mipmap_plugin.progress import announced

if TYPE_CHECKING:
    from mipmap_plugin.effects import Effect
    from mipmap_plugin.models.health import Health


def inspect(
    checkpoint: Checkpoint,
    iteration: int | None = None,
    screen_filter: ScreenFilter | None = None,
    viewers: bool = True,
    all: bool = False,
    json: bool = False,
) -> None:
    """Say whether a checkpoint is sound, what it is, which effects it needs, and what is wrong with it.

    Args:
        checkpoint: A PLY or a model folder.
        iteration: Which iteration of a model folder; by default the newest.
        screen_filter: The filter that the checkpoint was trained with, if its files do not say: mip for a fused file of Mip-Splatting, for example.
        viewers: Render a few views as web viewers do, and report their PSNR against the renders of the training.
        all: Also list the effects that are off, with reasons. The JSON always has them.
        json: Print JSON instead of sentences.
    """
    from mipmap_plugin.effects import explain
    from mipmap_plugin.evaluation.viewer_differences import viewer_differences
    from mipmap_plugin.models import load_model
    from mipmap_plugin.models.base import effects_of
    from mipmap_plugin.models.health import examine, holds_splats
    from mipmap_plugin.models.vanilla import VanillaModel
    from mipmap_plugin.wrap import wrap_model

    with announced(f"reading {checkpoint.name}"):
        model = load_model(checkpoint, iteration=iteration)
    with announced("examining"):
        wrapped = wrap_model(model, screen_filter=screen_filter)
        gaussians = model.gaussians(wrapped.views()[0])
        health = examine(model if holds_splats(model) else VanillaModel.from_gaussians(gaussians, model.trained))
        effects = explain(wrapped.effects(), gaussians, effects_of(model))
    with announced("drawing as viewers do"):
        differences = viewer_differences(wrapped) if viewers else "not requested"
    facts = {
        "verdict": _verdict(checkpoint, health),
        "file": str(model.source),
        "family": model.family,
        "splats": len(gaussians),
        "sh degree": f"{gaussians.used_sh_degree()} in use of {gaussians.sh_degree}",
        "trained with": f"{wrapped.trained.screen_filter}, {wrapped.trained.eps2d:g} px², background {wrapped.background}",
        "cameras": summary(wrapped.cameras),
        "effects": [str(effect) for effect in effects if effect.on or all or json] + _off(effects, shown=all or json),
        "health": health.sentences() or ["nothing found"],
        "viewers": differences,
        "notes": model.notes,
    }
    print_facts(facts, json)


def _verdict(checkpoint: Path, health: Health) -> str:
    """Whether the checkpoint is sound, and what to do with it."""
    advice = f"mipmap-plugin adapt {shlex.quote(str(checkpoint))} --scale 1/4"
    remarks = len(health.sentences())
    noted = f", with {remarks} remark{'s' if remarks > 1 else ''} (health)" if remarks else ""
    if health.spoilt():
        return "doubtful: read health before you adapt it"
    return f"sound{noted}; next: {advice}"


def _off(effects: Sequence[Effect], *, shown: bool) -> list[str]:
    """A line on the effects that are off and not shown."""
    count = sum(not effect.on for effect in effects)
    return [] if shown or not count else [f"{count} more are off (--all)"]
