"""A tradeoff from beginning to end: every scale measured, and what was measured written, also when it is interrupted."""

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
    """Measure and write into `folder`. `scene`: with photographs to judge by; `views`: how many of them at most.

    Ctrl-C raises Interrupted after what was measured until then is written. Raises SettingsError, BackendUnavailable, OutputExists
    and OutputError.
    """
    if 1 in scales:
        raise SettingsError("at scale 1 the base is right as it is, and nothing is to be traded; give another scale")
    yardsticks = [base_itself(model, scale, views) if scene is None else photographs(model, scene, scale, views) for scale in scales]
    notes = left_out(model, plan) + (not_exposed(model.model) if scene else [])
    found = [Tradeoff(scale, yardstick.label, [], notes) for scale, yardstick in zip(scales, yardsticks, strict=True)]
    try:
        for each, yardstick in zip(found, yardsticks, strict=True):
            for point in measure(model, yardstick, each.scale, plan):
                each.points.append(point)
    except KeyboardInterrupt:
        measured = [each for each in found if each.points]
        if not measured:
            raise Interrupted("interrupted; nothing was measured yet") from None
        write(folder, measured, complete=False)
        count = sum(len(each.points) for each in measured)
        raise Interrupted(f"interrupted; the {count} points that were measured until then are in {folder.path}; --overwrite replaces them") from None
    write(folder, found, complete=True)
    return found
