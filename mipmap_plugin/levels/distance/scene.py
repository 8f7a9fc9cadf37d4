"""What all levels of a ladder by distance share: the base, the rule, the chunks, and what follows from them for each level."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.amount import affordable_for
from mipmap_plugin.adaptation.target.resize import fitting
from mipmap_plugin.adaptation.views.farther import backed, foreground, stepping_back
from mipmap_plugin.adaptation.views.pixel_size import is_unbounded, nearest, pixel_size, seen_pixel_size
from mipmap_plugin.adaptation.views.shown import seeing
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.frozen_base import FrozenBase
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.levels.distance.chunks import Chunks
from mipmap_plugin.levels.distance.coarsening import shaped
from mipmap_plugin.levels.distance.rule import DistanceRule
from mipmap_plugin.levels.distance.walks import mean_focal
from mipmap_plugin.levels.request import LadderRequest
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.recipes import recipe as make_config
from mipmap_plugin.scenes.photographed import GOLDEN

# The settings of a zoom-out end here; at x1 nothing would be merged.
BELOW_1 = 1 - 1e-3


@dataclass(frozen=True, eq=False)
class DistanceScene:
    """What all levels of a ladder by distance share."""

    base: FrozenBase
    request: LadderRequest
    rule: DistanceRule
    chunks: Chunks  # of the base alone: what levels are made with
    extent: int  # the largest extent of a chunk, world units
    target: Effects
    backend: Backend
    note: str  # which backend, and why

    @cached_property
    def splats(self) -> Gaussians:
        """The splats of the base."""
        return self.splats_of(self.base.model)

    def splats_of(self, model: SplatModel) -> Gaussians:
        """The splats of a level, without gradients."""
        return model.gaussians(self.base.any_camera()).detach()

    @cached_property
    def views(self) -> list[Camera]:
        """The views of the training that see something."""
        return seeing(self.base.views(), self.splats.means, self.target.near_plane)

    def pixel_of(self, means: Tensor) -> Tensor:
        return pixel_size(means, self.views)

    @cached_property
    def near(self) -> float:
        """The size of a pixel of the training at the nearest parts of the scene that are seen, in world units."""
        return nearest(seen_pixel_size(self.splats.means, self.views, self.base.effects().near_plane))

    def scale(self, level: int) -> float:
        """The scale of a level at the nearest parts of the scene."""
        return min(1.0, self.near / self.rule.middle(level)) if level else 1.0

    def config(self, level: int) -> AdaptConfig:
        """The settings of a level. Nothing is pruned, so that the rows of the finer level, which come first, keep their places."""
        config = affordable_for(self.asked(level), self.splats.means, self.views, self.target.near_plane)
        config = fitting(config, self.base.effects(), self.views, 1.0)  # walks keep the size of their pictures
        return config.model_copy(update={"prune_every": max(1, config.steps)})

    def asked(self, level: int) -> AdaptConfig:
        """The settings of a level, before the size of the scene reduces its steps (`config`)."""
        return make_config(self.request.recipe, min(BELOW_1, self.scale(level)), merge_to=1.0, **self.request.settings)

    def unmade(self, finest: Gaussians, level: int) -> Gaussians:
        """A level that is not made yet, in closed form."""
        size, pixels = self.rule.middle(level), self.pixel_of(finest.means)
        scales, opacities = shaped(finest, pixels.clamp_max(size), size, self.target)
        changes = pixels < size
        scales, opacities = torch.where(changes[:, None], scales, finest.scales), torch.where(changes, opacities, finest.opacities)
        return replace(finest, scales=scales, opacities=opacities)

    def walked(self, view: Camera, level: int, number: int) -> Camera:
        """The `number`-th view, moved back so that the level is shown: two in three views by the whole way, each third by a part of it."""
        low, high = self.rule.ends(level)
        size = low * (high / low) ** ((number + 0.5) * GOLDEN % 1)
        way = max(0.0, size * mean_focal(view) - foreground(view, self.splats.means, self.target.near_plane))
        part = (number + 0.5) * GOLDEN**2 % 1 if number % 3 == 0 else 1.0
        return backed(view, part * way if math.isfinite(way) else 0.0)

    def farther(self) -> list[Camera]:
        """Every given view once more, from farther back, where its nearest parts are at a scale down to the ladder's coarsest.

        None without cameras, and none of a bounded scene, whose level 0 is shown near by alone.
        """
        means, near = self.splats.means, self.target.near_plane
        if not self.base.cameras or not is_unbounded(means, self.views, near):
            return []
        return stepping_back(self.views, means, near, self.request.coarsest)
