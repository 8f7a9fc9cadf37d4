"""What is said beside the rows of an evaluation: which ones are missing, and what they can be compared with."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

from mipmap_plugin.evaluation.evaluate import Evaluator, config_of
from mipmap_plugin.evaluation.judged import not_exposed
from mipmap_plugin.evaluation.measure import FILTERS
from mipmap_plugin.evaluation.protocols import Protocol
from mipmap_plugin.models.base import SplatModel, effects_of
from mipmap_plugin.recipes import most_steps
from mipmap_plugin.wrap import Wrapped


def notes(model: Wrapped, judge: Evaluator, scales: Sequence[float], recipes: Sequence[str], settings: dict[str, Any], appearance: str) -> list[str]:
    """Notes on the scene, missing rows, exposures, the appearance of test views and filters, in sentences. `settings`: as of `all_rows`."""
    missing = {name: model.lacks(name) for name in FILTERS if any(scale != 1 for scale in scales)}
    rows = [f"there is no row {name!r}, since {reason}" for name, reason in missing.items() if reason]
    of_model = [*not_exposed(model.model), *_appearance_note(model.model, appearance)]
    return [*judge.notes, *rows, *of_model, *_other_filters(judge.protocol, scales, recipes, settings)]


def _other_filters(protocol: Protocol, scales: Sequence[float], recipes: Sequence[str], settings: dict[str, Any]) -> list[str]:
    """Which recipes are adapted to images that another filter made smaller than the truth's, in a sentence."""
    truth, used = protocol.shrink_by, dict[str, str]()
    same = {"box": "area"}.get(truth, truth)  # means of whole blocks, and of any
    for name, scale in product(recipes, scales):
        config = config_of(name, scale, settings)
        own = "pil-bicubic" if config.resize == "fitting" else config.resize  # as it is for all but the narrowest pictures
        if scale < 1 and most_steps(name, scale, config.steps) and own not in (truth, same):
            used[name] = own
    others = ", ".join(f"{name} ({own})" for name, own in used.items())
    aimed = f"--resize {same} adapts to images that are made as the truth is"
    return [f"{protocol.name} makes photographs smaller by another filter ({truth}) than base images are for {others}; {aimed}"] if others else []


def _appearance_note(model: SplatModel, appearance: str) -> list[str]:
    """The appearance of test views in a sentence, if the model has appearances; `appearance`: "mean" or "upstream"."""
    if not any(effect.name == "appearance embedding" and effect.on for effect in effects_of(model)):
        return []
    if appearance == "upstream":
        return ["test views have the appearance of the training view with the same number, as in the original, whatever that view looked like"]
    return ["test views have the mean appearance of all training views; the original has that of the same number (--appearance upstream)"]
