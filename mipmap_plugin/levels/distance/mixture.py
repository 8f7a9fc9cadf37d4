"""What a viewer shows that chooses a level for each chunk: some splats of every level, drawn together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.levels.distance.chunks import Chunks
from mipmap_plugin.levels.distance.rule import DistanceRule, focal_along_shorter_side
from mipmap_plugin.splatting.harmonics import C0


@dataclass(frozen=True, eq=False)
class Mixture:
    """The levels of a scene by chunk."""

    rule: DistanceRule
    chunks: Chunks
    levels: Sequence[Gaussians]  # from the finest; as many as the rule has
    places: Sequence[Tensor]  # the chunk of each splat of each level

    @classmethod
    def of(cls, rule: DistanceRule, chunks: Chunks, levels: Sequence[Gaussians]) -> Mixture:
        """Levels whose splats lie in the chunk of their center."""
        return cls(rule, chunks, levels, [chunks.of_points(level.means.detach()) for level in levels])

    @classmethod
    def streamed(cls, rule: DistanceRule, extent: float, levels: Sequence[Gaussians]) -> Mixture:
        """Levels that are all made, cut together into chunks of this extent, as splat-transform writes them."""
        colorless = [replace(level, sh=level.sh[:, :1]) for level in levels]  # which spares a copy of what is largest
        return cls.of(rule, Chunks.of(joined(colorless), extent), levels)

    def shown(self, camera: Camera) -> Tensor:
        """The level at which the camera sees each chunk, [C]."""
        return self.rule.level(self.chunks.distances(camera.center) / focal_along_shorter_side(camera))

    def splats(self, camera: Camera) -> Gaussians:
        """The splats that the camera sees."""
        shown = self.shown(camera)
        return joined([level[shown[place] == number] for number, (level, place) in enumerate(zip(self.levels, self.places, strict=True))])

    def with_student(self, number: int, student: Gaussians, camera: Camera, fixed: int) -> Gaussians:
        """The splats that the camera sees, with `student` in place of a level; its first `fixed` splats have no gradient."""
        shown = self.shown(camera)
        rows = (shown[self.places[number]] == number).nonzero()[:, 0]
        still, live = student[rows[rows < fixed]].detach(), student[rows[rows >= fixed]]
        others = [level[shown[self.places[k]] == k] for k, level in enumerate(self.levels) if k != number]
        return joined([*others, still, live])

    def part_of(self, number: int, live: Tensor, camera: Camera) -> Gaussians:
        """The splats that the camera sees, in white those of a level that are `live` [N], all others in black."""
        shown = self.shown(camera)
        parts = []
        for k, (level, place) in enumerate(zip(self.levels, self.places, strict=True)):
            here = shown[place] == k
            white = (live[here] if k == number else torch.zeros_like(here[here])).to(level.means)
            parts.append(replace(level[here], sh=((white - 0.5) / C0)[:, None, None].expand(-1, 1, 3)))
        return joined(parts)


def joined(parts: Sequence[Gaussians]) -> Gaussians:
    """One set of splats from several of the same SH degree."""
    return Gaussians(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(Gaussians) if field.name != "covariances"))
