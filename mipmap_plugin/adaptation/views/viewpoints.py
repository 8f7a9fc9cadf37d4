"""Where a scene that came without cameras is looked at from: an orbit, and of a capture those of its views that see it clearly."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import torch
from torch import Tensor

from mipmap_plugin.adaptation.parallel import max_threads
from mipmap_plugin.adaptation.target.base_images import facts
from mipmap_plugin.adaptation.warn import warn
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import ONE_PIXEL, Camera, evenly
from mipmap_plugin.effects import Effects, colorless
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.adapted_scale import adapted_orbit
from mipmap_plugin.models.base import SplatModel, TrainedScale, means_at
from mipmap_plugin.models.contract import checked_splats
from mipmap_plugin.plugin_errors import naming_any
from mipmap_plugin.process.threads import side_by_side
from mipmap_plugin.scenes.orbits import EVERY, Orbit, radius_if_small, sharp_size
from mipmap_plugin.scenes.photographed import sizes
from mipmap_plugin.splatting.harmonics import C0

# A view stands in fog, or behind a wall, if more than half of what it shows are splats larger (`sizes`) than FOG of its shorter side. The median is
# 0.01 to 0.07 in photographs of four captures, and 0.1 to 4 in such views; limits of 0.035 to 0.2 choose as well.
FOG = 0.1

# px: the shorter side of the pictures that tell.
LOOK = 64

# At most so many times as many views are tried as are wanted. Of a kitchen that was photographed from one side a quarter are clear.
ROUNDS = 4

# Where that is few, as for validation, so many are tried until there are two, one to steer by and one to choose by. Of one capture
# a twelfth are clear, and of 24 that validation tried only one was.
TRIED, PAIR = 100, 2

# Moments of a moving scene, whose splats at all of them an orbit goes around.
MOMENTS = (0.0, 0.5, 1.0)

# If a time budget allows to look at fewer views than this, any are taken.
LEAST_LOOKS = 16

# Which of five pairs of views is finer. Of validation views the first of a pair steers and the second chooses: so as many of both are finer, one of
# eight views each, two of sixteen, and none of four.
FINER_PAIR = 2

# The near plane of a small scene, as a fraction of the radius that pictures show: that of 3DGS in a scene that is 4 units wide. So many standard
# deviations of a splat are seen; where they are more than the radius, it is a few splats that are seen, and no scene.
NEAR_SHARE, REACH = 0.1, 3.0

INSTEAD = "give the scene's cameras (--cameras), or adapt for what you look at (mipmap-plugin view)"
UNCLEAR = f"no generated view that was looked at sees this capture clearly, only through fog or walls, or nothing: any are taken; {INSTEAD}"
HURRIED = f"the time budget leaves no time to look for views that see this capture clearly: any are taken; give more, or {INSTEAD}"


@dataclass(frozen=True)
class Viewpoints:
    """Of a scene without cameras: what views go around, and which of them see it clearly.

    Views beside the middle are for steps alone: a single one in validation, of fog that a viewer draws at 6 dB, had a capture's steps taken back.
    """

    orbit: Orbit
    clear: Callable[[Sequence[Camera]], list[Camera]]  # those of the views that see it clearly (`ClearViews`)
    looks: float = math.inf  # so many views may be looked at (`amount.looks_in_budget`)
    finer: bool = True  # whether a fifth of the views are finer (`Orbit.finer`); False for views that take the place of the training's
    beside: bool = False  # whether half of the views in place of unclear ones look beside the middle, unless colors tell where cameras were

    def views(self, size: tuple[int, int], count: int, generator: torch.Generator) -> list[Camera]:
        """`count` views of `size` (height, width) px. Of a capture they are clear: fewer where fewer are, and any, with a warning, where none is."""
        views = self._in_one_detail(size, count, generator)
        numbers = [number for number in range(len(views)) if number % (2 * EVERY) // 2 == FINER_PAIR] if self.finer and self.orbit.focal else []
        finer = [self.orbit.finer(views[number], size, generator) for number in numbers]
        clear = self.clear(finer) if self.looks == math.inf else finer  # a time budget is spent on looking at the others
        taken = {number: view for number, view in zip(numbers, finer, strict=True) if view in clear}
        return [taken.get(number, view) for number, view in enumerate(views)]

    def _in_one_detail(self, size: tuple[int, int], count: int, generator: torch.Generator) -> list[Camera]:
        """The `views`, none of which is finer."""
        first = self.orbit.views(size, count, generator)
        if not self.orbit.nearest:
            return first
        if self.looks < min(count, LEAST_LOOKS):
            warn(HURRIED)
            return first
        looked_at = evenly(first, int(min(self.looks, count)))
        found, tried = self.clear(looked_at), len(looked_at)
        for number in range(1, max(ROUNDS, math.ceil(TRIED / count))):
            if number >= ROUNDS and len(found) >= PAIR:
                break
            missing = count - len(found)
            most = int(min(math.ceil(missing * tried / max(1, len(found))), count, self.looks - tried))
            if most > 0:
                others = self.orbit.views(size, count, generator, number * count, beside=self.beside and not self.orbit.seen)
                looked_at = evenly(others, most)
                found, tried = found + evenly(self.clear(looked_at), missing), tried + most
        if not found:
            warn(UNCLEAR)
        return found or first

    def best(self, views: Sequence[Camera]) -> list[Camera]:
        """Those of the orbit's views that see a capture clearly, or all if none does."""
        return (self.clear(views) if self.orbit.nearest else []) or list(views)


class ClearViews:
    """Finds the views that see a model clearly. Each is looked at once."""

    def __init__(self, model: SplatModel, backend: Callable[[], tuple[Backend, str]], effects: Effects) -> None:
        """`effects`: how the model is rendered at its own scale.

        `backend`: chooses what draws the model (`choose_backend`). Not a method of the base: that would keep the base in memory.
        """
        self._model, self._backend, self._effects = model, backend, colorless(effects)
        self._known: dict[Hashable, bool] = {}  # by `facts`

    @torch.no_grad()
    def __call__(self, views: Sequence[Camera]) -> list[Camera]:
        """Those of the views that see the model clearly. All of a model whose splats have covariances instead of scales."""
        unknown = [view for view in views if facts(view) not in self._known]
        if unknown:
            # With the zoom of the views, so that a model shows as many splats as in these.
            small = [replace(view.zoomed(LOOK / min(view.size)), zoom=view.zoom) for view in unknown]
            backend, _ = self._backend()
            once = self._model.gaussians(unknown[0]) if self._model.traits.same_for_all_views else None
            threads = max_threads(self._model.parameters()["means"], small[0])
            shown = side_by_side(lambda view: self._is_clear(view, backend, once), small, threads)
            self._known.update(zip(map(facts, unknown), shown, strict=True))
        return [view for view in views if self._known[facts(view)]]

    def _is_clear(self, view: Camera, backend: Backend, once: Gaussians | None) -> bool:
        splats = self._model.gaussians(view) if once is None else once
        if splats.covariances is not None:
            return True
        depth = view.to_camera(splats.means)[:, 2]
        large = (sizes(splats) * view.fx > FOG * min(view.size) * depth).to(splats.means)
        colors = torch.stack([large, torch.ones_like(large), large], dim=1)  # an image is linear in them: its sums are those of blend weights
        drawn = backend.render(replace(splats, sh=((colors - 0.5) / C0)[:, None]), view, self._effects).image
        fog, all_of_it, _ = drawn.sum((0, 1)).tolist()
        return bool(all_of_it > 0 and fog <= all_of_it / 2)


def orbit_of(model: SplatModel, trained: TrainedScale, means: Tensor | None = None, *, lone: bool = False) -> Orbit:
    """What an orbit around a model goes around. That of an adapted file is its base's, so that both are seen from the same places.

    `trained`: with the vertical, as the user or the base's files say, and the near plane (`wrap.Wrapped.trained`). `means` [N, 3]: of all splats,
    where the model has but some of its file. `lone`: it came without cameras, so that its colors are asked where it was photographed.
    """
    recorded = adapted_orbit(model.source)
    if recorded is None:
        same, splats = model.traits.same_for_all_views, cache(partial(model.gaussians, ONE_PIXEL))
        near, places = trained.near_plane, everywhere(model) if means is None else means
        orbit = Orbit.around(places, lambda: sharp_size(splats()) if same else math.inf, near)
        if lone and same:
            orbit = orbit.where_photographed(splats(), near)
    else:
        orbit = Orbit(**recorded)
    return orbit if trained.up is None else replace(orbit, up=trained.up, said=True)


def near_plane_for(model: SplatModel, usual: float) -> float:
    """The near plane, in world units, of a model that came without cameras: as `usual`, or nearer for a small scene, which views are to frame.

    Objects of less than 0.6 units, as phones scan them in meters, were seen from too far away, and adapted to smaller pictures than was asked for.
    Raises PluginError.
    """
    if model.traits.moves or not model.traits.same_for_all_views:
        return usual
    radius = radius_if_small(model.parameters()["means"].detach(), usual)
    if not radius:
        return usual
    with torch.no_grad(), naming_any({f"family {model.family!r}": model}):
        splats = checked_splats(model, ONE_PIXEL)
    few = REACH * float(sizes(splats).nanmedian()) > radius
    return usual if few else NEAR_SHARE * radius


def everywhere(model: SplatModel) -> Tensor:
    """Where the rows of a model's parameters are, [N, 3]; of one that moves at several moments, [M, 3]."""
    views = [replace(ONE_PIXEL, time=time) for time in MOMENTS] if model.traits.moves else [ONE_PIXEL]
    return torch.cat([means_at(model, view) for view in views])
