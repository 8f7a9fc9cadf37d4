"""`mipmap-plugin inspect`."""

from __future__ import annotations

from mipmap_plugin.commands.common import print_facts, summary
from mipmap_plugin.commands.types import Checkpoint, ScreenFilter


def inspect(
    checkpoint: Checkpoint, iteration: int | None = None, screen_filter: ScreenFilter | None = None, viewers: bool = True, json: bool = False
) -> None:
    """Report what a checkpoint is, which effects it needs, and what is wrong with it.

    Args:
        checkpoint: A PLY or a model folder.
        iteration: Which iteration of a model folder; by default the newest.
        screen_filter: The filter that the checkpoint was trained with, if its files do not say: mip for a fused file of Mip-Splatting, for example.
        viewers: Render a few views as web viewers do, and report their PSNR against the renders of the training.
        json: Print JSON instead of sentences.
    """
    from mipmap_plugin.effects import explain
    from mipmap_plugin.evaluation.viewer_differences import viewer_differences
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
        "viewers": viewer_differences(wrapped) if viewers else "not requested",
        "notes": model.notes,
    }
    print_facts(facts, json)
