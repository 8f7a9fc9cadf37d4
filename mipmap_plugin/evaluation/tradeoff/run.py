"""A complete tradeoff: every scale is measured, and the results are written, also after an interruption."""

from __future__ import annotations

from collections.abc import Sequence

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation.protocols import not_exposed
from mipmap_plugin.evaluation.tradeoff.files import Folder, write
from mipmap_plugin.evaluation.tradeoff.front import Tradeoff
from mipmap_plugin.evaluation.tradeoff.points import Plan, left_out, measure
from mipmap_plugin.evaluation.tradeoff.truth import base_itself, photographs
from mipmap_plugin.scenes import Scene
from mipmap_plugin.wrap import Interrupted, Wrapped


def run(model: Wrapped, scene: Scene | None, scales: Sequence[float], plan: Plan, views: int | None, folder: Folder) -> list[Tradeoff]:
    """Measure, and write the results to `folder`. `scene`: with photographs to compare with; `views`: maximum number of them.

    Ctrl-C writes the results so far and raises Interrupted. Raises SettingsError, BackendUnavailable, OutputExists and OutputError.
    """
    if 1 in scales:
        raise SettingsError("at scale 1 the base needs no adaptation; give another scale")
    truths = [base_itself(model, scale, views) if scene is None else photographs(model, scene, scale, views) for scale in scales]
    notes = left_out(model, plan) + (not_exposed(model.model) if scene else [])
    tradeoffs = [Tradeoff(scale, truth.label, [], notes) for scale, truth in zip(scales, truths, strict=True)]
    try:
        for tradeoff, truth in zip(tradeoffs, truths, strict=True):
            for point in measure(model, truth, tradeoff.scale, plan):
                tradeoff.points.append(point)
    except KeyboardInterrupt:
        measured = [tradeoff for tradeoff in tradeoffs if tradeoff.points]
        if not measured:
            raise Interrupted("interrupted; nothing was measured yet") from None
        write(folder, measured, complete=False)
        count = sum(len(tradeoff.points) for tradeoff in measured)
        raise Interrupted(f"interrupted; the {count} points measured so far are in {folder.path}; --overwrite replaces them") from None
    write(folder, tradeoffs, complete=True)
    return tradeoffs
