"""A complete tradeoff: every scale is measured, and the results are written, also after an interruption."""

from __future__ import annotations

from collections.abc import Sequence

from mipmap_plugin.errors import SettingsError, plural
from mipmap_plugin.evaluation.cells import Cells
from mipmap_plugin.evaluation.judged import not_exposed, not_held_out
from mipmap_plugin.evaluation.tradeoff.files import KEPT, Folder, goes_on, write
from mipmap_plugin.evaluation.tradeoff.front import Tradeoff
from mipmap_plugin.evaluation.tradeoff.measuring import left_out, measure
from mipmap_plugin.evaluation.tradeoff.points import Plan
from mipmap_plugin.evaluation.tradeoff.truth import base_itself, photographs
from mipmap_plugin.progress import note
from mipmap_plugin.scenes import Scene
from mipmap_plugin.wrap import Wrapped


def run(model: Wrapped, scene: Scene | None, scales: Sequence[float], plan: Plan, views: int | None, folder: Folder) -> list[Tradeoff]:
    """Measure, and write the results to `folder`. `scene`: with photographs to compare with; `views`: maximum number of them.

    Ctrl-C writes the results so far. Raises SettingsError, BackendUnavailable, OutputExists and OutputError.
    """
    if 1 in scales:
        raise SettingsError("at scale 1 the base needs no adaptation; give another scale")
    if views is not None and views < 1:
        raise SettingsError(f"views: at least 1 must be evaluated on, got {views}")
    model.refuse_undrawn(scale=min(scales))
    there = model.place(scene) if scene else None
    truths = [base_itself(model, scale, views) if there is None else photographs(model, there, scale, views) for scale in scales]
    made_from = {"base": model.model.digest, "asked": model.asked, "trained": str(model.trained), "scene": scene and scene.digest()}
    cells = Cells(folder.path / KEPT, made_from | {"views": views, "threads": model.threads})
    notes = left_out(model, plan) + ([*there.notes, *not_held_out(model, there), *not_exposed(model.model)] if there else [])
    tradeoffs = [Tradeoff(scale, truth.label, [], notes) for scale, truth in zip(scales, truths, strict=True)]
    try:
        for tradeoff, truth in zip(tradeoffs, truths, strict=True):
            for point in measure(model, truth, tradeoff.scale, plan, cells):
                tradeoff.points.append(point)
    except KeyboardInterrupt:
        if measured := [tradeoff for tradeoff in tradeoffs if tradeoff.points]:
            write(goes_on(folder), measured, complete=False)
            note(f"the {plural(sum(len(tradeoff.points) for tradeoff in measured), 'point')} measured so far: {folder.path}")
        raise
    write(goes_on(folder), tradeoffs, complete=True)
    return tradeoffs
