"""`mipmap-plugin inspect`."""

from __future__ import annotations

from mipmap_plugin.commands.common import summary, tell
from mipmap_plugin.commands.types import Checkpoint, ScreenFilter


def inspect(
    checkpoint: Checkpoint, iteration: int | None = None, screen_filter: ScreenFilter | None = None, viewers: bool = True, json: bool = False
) -> None:
    """Say what a checkpoint is, what it calls for, and what is wrong with it.

    Args:
        checkpoint: A PLY or a model folder.
        iteration: Which iteration of a model folder; the newest by default.
        screen_filter: What it was trained with, where its files do not say: mip for a fused file of Mip-Splatting, for example.
        viewers: Draw a few views as viewers on the web do, and say how far they are from those of training.
        json: Print JSON instead of sentences.
    """
    from mipmap_plugin.effects import explain
    from mipmap_plugin.evaluation.looks import looks
    from mipmap_plugin.models import load_model
    from mipmap_plugin.models.base import effects_of
    from mipmap_plugin.models.health import examine, holds_splats
    from mipmap_plugin.models.vanilla import VanillaModel
    from mipmap_plugin.wrap import wrap_model

    model = load_model(checkpoint, iteration=iteration)
    wrapped = wrap_model(model, screen_filter=screen_filter)
    view = wrapped.views()[0]
    gaussians = model.gaussians(view)
    facts = {
        "file": str(model.source),
        "family": model.family,
        "splats": len(gaussians),
        "sh degree": f"{gaussians.used_sh_degree()} in use of {gaussians.sh_degree}",
        "trained with": f"{wrapped.trained.screen_filter}, {wrapped.trained.eps2d:g} px², background {wrapped.background}",
        "cameras": summary(wrapped.cameras),
        "effects": [str(effect) for effect in explain(wrapped.effects(), gaussians, effects_of(model))],
        "health": examine(model if holds_splats(model) else VanillaModel.from_gaussians(gaussians, model.trained)).sentences() or ["nothing found"],
        "viewers": looks(wrapped) if viewers else "not asked for",
        "notes": model.notes,
    }
    tell(facts, json)
