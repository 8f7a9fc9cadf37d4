"""Viewers whose near plane alone differs from that of the base's training: mostly no view shows the difference."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch

from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera, digest_of
from mipmap_plugin.effects import Effects
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.progress import announced


@dataclass(frozen=True, eq=False)
class NearPlanes:
    """Whether renderers that differ in the near plane alone, as INRIA's and gsplat's do, draw a base alike. Each answer is kept, since all views have
    to look at all splats for it."""

    base: SplatModel
    trained: Effects  # how the base is rendered
    choice: Callable[[], tuple[Backend, str]]  # of what renders it
    known: dict[tuple[float, str], bool] = field(default_factory=dict)  # by near plane and views

    def target(self, effects: Effects, views: Callable[[], Sequence[Camera]]) -> Effects:
        """How a viewer with these effects draws: as the base's training did, where none of the views shows a splat between both near planes."""
        if effects == self.trained or replace(effects, near_plane=self.trained.near_plane) != self.trained:
            return effects
        asked = effects.near_plane, digest_of(seen := views())
        if asked not in self.known:
            self.known[asked] = self._alike(effects.near_plane, seen)
        return self.trained if self.known[asked] else effects

    @announced("examining views")
    @torch.no_grad()
    def _alike(self, near: float, views: Sequence[Camera]) -> bool:
        nearest, farthest = sorted((near, self.trained.near_plane))
        effects, means, (backend, _) = replace(self.trained, near_plane=nearest), self.base.parameters()["means"], self.choice()
        once = self.base.gaussians(views[0]) if self.base.traits.same_for_all_views else None
        for view in views:
            depths = (means - view.center.to(means)) @ view.viewmat[2, :3].to(means)
            between = (depths > nearest) & (depths <= farthest)
            # Most of them lie beside the picture: what they show tells.
            if between.any() and backend.render((once or self.base.gaussians(view))[between], view, effects).alpha.any():
                return False
        return True
