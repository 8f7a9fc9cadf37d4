"""Pictures of splats that do not fit into memory: drawn slab after slab, front to back.

A renderer blends splats in the order of their depth. So a picture is exact if splats of rising depth are drawn some at a time, each
slab behind what the slabs before it let through: C = C_1 + T_1 (C_2 + T_2 (...)). What is behind an opaque slab is not read at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from mipmap_plugin.adaptation.start.blend_weights import PARTS, SHOWN
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects, colorless
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.harmonics import C0
from mipmap_plugin.tiles.splats import Splats

# Splats of a slab: about 100 MB while it is drawn.
SLAB = 200_000

# The same without colors, which are four fifths of a splat.
COLORLESS_SLAB = 4 * SLAB

# Pixels of a strip, of which blend weights are found.
MOST_PIXELS = 1 << 19

# Splats whose depths tell where slabs begin.
SAMPLE = 1 << 14

BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Layer:
    """A picture of some splats, with what they let through."""

    image: Tensor  # [H, W, 3], on black
    transmittance: Tensor  # [H, W, 1]

    def over(self, background: Tensor) -> Tensor:
        """The picture [H, W, 3] in front of a color [3] or another picture."""
        return self.image + self.transmittance * background


@dataclass(frozen=True, eq=False)
class Painter:
    """Draws splats from the disk."""

    backend: Backend
    effects: Effects

    @torch.no_grad()
    def draw(self, splats: Splats, camera: Camera) -> Layer:
        """The picture of all splats that the camera sees."""
        effects = replace(self.effects, background=BLACK)
        parts = slabs(*splats.seen_by(camera, effects.near_plane), SLAB)
        if not parts:
            return Layer(torch.zeros(*camera.size, 3), torch.ones(*camera.size, 1))
        first = self.backend.render(splats.gaussians(parts[0]), camera, effects)
        image, through = first.image, (1 - first.alpha)[..., None]
        for slab in parts[1:]:
            if float(through.max()) < effects.settings.min_transmittance:
                break
            rendered = self.backend.render(splats.gaussians(slab), camera, effects)
            image.addcmul_(through, rendered.image)
            through.mul_((1 - rendered.alpha)[..., None])
        return Layer(image, through)

    def image(self, splats: Splats, camera: Camera) -> Tensor:
        """The picture [H, W, 3] of all splats in front of the background."""
        return self.draw(splats, camera).over(torch.tensor(self.effects.background))

    def weighed(self, splats: Splats, cameras: Sequence[Camera], parts: Sequence[int]) -> tuple[Tensor, float]:
        """`blend_weights.weighed` of splats on the disk: blend weights [N, P], px, and the fraction of the splats that a view shows."""
        total, shown = torch.zeros(PARTS, len(splats)), 0.0
        for part, view in zip(parts, cameras, strict=True):
            weights = torch.zeros(len(splats))
            for strip in strips(view):
                self._weigh(splats, strip, weights)
            total[part] += weights / len(cameras)
            shown += float((weights > SHOWN).float().mean()) / len(cameras)
        return total.T, shown

    def _weigh(self, splats: Splats, camera: Camera, weights: Tensor) -> None:
        """Add the blend weight of each splat in a view to `weights` [N]."""
        effects = colorless(self.effects)
        parts = slabs(*splats.seen_by(camera, effects.near_plane), COLORLESS_SLAB)
        through = torch.ones(*camera.size, 1)
        for slab in parts:
            gaussians = splats.gaussians(slab, colored=False)
            weigh = getattr(self.backend, "blend_weights", None) if len(parts) == 1 else None  # which knows nothing of what is in front
            if weigh is not None and (known := weigh(gaussians, camera, effects)) is not None:
                weights[slab] += known
                return
            weights[slab] += self._slab_weights(gaussians, camera, effects, through)
            if float(through.max()) < effects.settings.min_transmittance:
                return

    @torch.enable_grad()
    def _slab_weights(self, gaussians: Gaussians, camera: Camera, effects: Effects, through: Tensor) -> Tensor:
        """The blend weights [M] of a slab behind what lets `through` [H, W, 1], which becomes what the slab lets through."""
        color = gaussians.sh.requires_grad_()
        rendered = self.backend.render(replace(gaussians, sh=color), camera, effects)
        (through * rendered.image).sum().backward()
        assert color.grad is not None
        through *= (1 - rendered.alpha.detach())[..., None]
        return color.grad[:, 0].mean(dim=1) / C0


def slabs(rows: Tensor, depths: Tensor, most: int) -> list[Tensor]:
    """`rows` [M] of splats at `depths` [M] in slabs of rising depth, of about `most` rows at most; rows keep their order."""
    count = -(-len(rows) // most)
    if count < 2:
        return [rows] if count else []
    some = depths[:: max(1, len(depths) // SAMPLE)].sort().values
    slab_of = torch.bucketize(depths, some[[len(some) * number // count for number in range(1, count)]], right=True)
    return [rows[slab_of == number] for number in range(count)]


def strips(camera: Camera) -> list[Camera]:
    """A view in strips of at most `MOST_PIXELS`, whose blend weights add up to its own: the lists of many splats take memory for each pixel."""
    count = -(-camera.width * camera.height // MOST_PIXELS)
    ends = [camera.height * number // count for number in range(count + 1)]
    return [replace(camera, height=end - top, cy=camera.cy - top) for top, end in pairwise(ends) if end > top]
