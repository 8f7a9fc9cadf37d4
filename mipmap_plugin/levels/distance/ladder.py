"""A ladder of levels by distance: as `levels.ladder`, but each splat of a level is at the scale at which a viewer's rule shows it."""

from __future__ import annotations

import gc
import math
from dataclasses import replace
from pathlib import Path

import torch

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.views.farther import foreground
from mipmap_plugin.adaptation.views.pixel_size import is_unbounded, nearest, seen_pixel_size
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.frozen_base import FrozenBase
from mipmap_plugin.levels.contents import LeftOut
from mipmap_plugin.levels.distance.chunks import LEAST_OF_BASE, Chunks
from mipmap_plugin.levels.distance.level import AS_FINER, LevelRun
from mipmap_plugin.levels.distance.manifest import DistanceContents, manifest
from mipmap_plugin.levels.distance.rule import DistanceRule
from mipmap_plugin.levels.distance.scene import DistanceScene
from mipmap_plugin.levels.distance.walks import mean_focal
from mipmap_plugin.levels.distance.yardstick import measured
from mipmap_plugin.levels.finished import Ladder
from mipmap_plugin.levels.request import STREAMING, Band, LadderRequest
from mipmap_plugin.levels.store import LevelStore
from mipmap_plugin.process import threads
from mipmap_plugin.progress import announced
from mipmap_plugin.screen_filters import INTEGRATED
from mipmap_plugin.splatting.viewers import own_name

# A chunk measures at most this part of the distance of the nearest parts of a scene, so that its rear is at the scale of its front, but at least
# one world unit: splat-transform takes whole numbers.
CHUNK = 0.5

# Why a level at the end of a ladder is left out.
REPEATED = "nothing was better than the finer level as it is"


def make_levels_by_distance(base: FrozenBase, request: LadderRequest, resume: Path | None) -> Ladder:
    """Make the levels. `resume`: as for `levels.ladder.make_levels`. Raises what that raises, and SettingsError for a model whose splats cannot be
    merged, or for settings that levels by distance do not have."""
    refuse(base, request)
    band = request.first_band(base)
    with announced("cutting the scene into chunks"):
        scene = scene_of(base, request, band)
        store = LevelStore(resume, base, request)
    # Adapted to the views of the training alone, level 0 would be worse than the base wherever nobody trained: its far parts are in every level.
    with announced("level 0: choosing views"):
        cameras = [*base.cameras, *farther] if (farther := scene.farther()) else None
    first = store.level("level_0", lambda state: base.adapt(1.0, cameras=cameras, resume=state, **request.for_first(base, band)))
    with threads.limited_for(scene.backend, base.threads):
        levels = [first]
        for number in range(1, scene.rule.count):
            levels.append(_level_below(scene, number, levels, store))
            gc.collect()  # a run and its own functions hold one another, and gigabytes of pictures, until somebody looks for such circles
        scene, levels, left_out = without_repeats(scene, levels)
        with announced("measuring the levels"):
            curve = measured(scene, [level.model for level in levels])
    return Ladder(DistanceContents(scene, levels, curve, left_out), store, manifest)


def _level_below(scene: DistanceScene, number: int, finer: list[Adapted], store: LevelStore) -> Adapted:
    """The `number`-th level, below all finer ones."""
    with announced(f"level {number}: choosing views"):
        run = LevelRun(scene, number, [level.model for level in finer])
    return store.level(f"level_{number}", run.run)


def without_repeats(scene: DistanceScene, levels: list[Adapted]) -> tuple[DistanceScene, list[Adapted], list[LeftOut]]:
    """A ladder without the levels at its end that are the finer one again, which a viewer shows in their place: the same picture, at fewer bytes.

    One before another level stays: the distances at which a viewer changes are in a fixed proportion, so that each level needs the one before.
    """
    own = next(number for number in range(len(levels), 0, -1) if levels[number - 1].report.returned != f"the start, {AS_FINER}")
    left_out = [LeftOut(scene.scale(number), levels[number].report.gaussians_after, REPEATED) for number in range(own, len(levels))]
    return replace(scene, rule=replace(scene.rule, count=own, left_out=len(left_out))), levels[:own], left_out


def by_distance(base: FrozenBase, request: LadderRequest) -> bool:
    """Whether the levels of a request are made by distance. `auto`: not where no cameras tell any."""
    if request.by != "auto":
        return request.by == "distance"
    if not base.cameras or request.least_db is not None or request.until_splats is not None:
        return False
    effects, means = base.effects(), base.model.parameters()["means"].detach()
    mergeable = base.model.traits.same_for_all_views and not base.model.traits.filtered and effects.screen_filter not in INTEGRATED
    return mergeable and own_name(request.viewer) in STREAMING and is_unbounded(means, base.views(), effects.near_plane)


def refuse(base: FrozenBase, request: LadderRequest) -> None:
    """Raise SettingsError for what levels by distance do not support."""
    if base.model.traits.filtered or not base.model.traits.same_for_all_views:
        raise SettingsError(f"{base.model.family}: its splats have a 3D filter, so that levels by distance cannot mix them; give by zoom")
    if (trained_with := base.effects().screen_filter) in INTEGRATED:
        raise SettingsError(f"levels by distance need a base with a dilation; this one was trained with {trained_with}; give by zoom")
    means, near = base.model.parameters()["means"].detach(), base.effects().near_plane
    if not any(math.isfinite(foreground(view, means, near)) for view in base.views()):
        raise SettingsError("no camera sees a splat, so that no distance follows from them; give the scene's --cameras, or levels by zoom")
    if request.least_db is not None or request.until_splats is not None:
        raise SettingsError("least_db and until_splats: levels by distance follow from the distances of the cameras; leave both out")
    if taken := {"merge_to", "most_splats"} & request.settings.keys():
        raise SettingsError(f"{', '.join(sorted(taken))}: levels by distance have as many splats as their distances need; leave out")


def scene_of(base: FrozenBase, request: LadderRequest, band: Band) -> DistanceScene:
    """The rule and the chunks that suit a base. Raises BackendUnavailable."""
    backend, note = base.backend(gradients=True, viewer=request.viewer)
    with torch.no_grad():
        splats, views = base.model.gaussians(base.any_camera()).detach(), base.views()
        pixels = seen_pixel_size(splats.means, views, base.effects().near_plane)
        rule = DistanceRule.of(pixels, request, band)
        extent = max(1, round(CHUNK * nearest(pixels) * mean_focal(views[0])))
        return DistanceScene(base, request, rule, Chunks.of(splats, extent, LEAST_OF_BASE), extent, base.target(request.viewer), backend, note)
