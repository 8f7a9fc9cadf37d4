"""What levels by distance are measured by: walks that no level was adapted to, drawn as the viewer mixes the levels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
from torch import Tensor

from mipmap_plugin.adaptation.curve import decibel
from mipmap_plugin.adaptation.views.farther import backed, foreground
from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.levels.distance.mixture import Mixture
from mipmap_plugin.levels.distance.rule import DistanceRule
from mipmap_plugin.levels.distance.scene import DistanceScene
from mipmap_plugin.levels.distance.walks import WalkTruth, mean_focal
from mipmap_plugin.levels.yardstick import DRAW, VIEWS
from mipmap_plugin.limits import derived_seed
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.scenes.trajectories import jittered, with_company

# Samples of the truth per pixel along each side: more than a level is adapted to. In walks over flowers, three agree with six to 67 dB.
SAMPLES = 3

TRUTH = (
    f"mean PSNR over at most {VIEWS} random walks backwards that no level was adapted to, levels chosen by chunk, against the base with "
    f"{SAMPLES} x {SAMPLES} samples a pixel, its dilation as large in the world as where the walk begins"
)

# The end of a level, as a part of the size of a pixel there: just before the next one is shown.
WITHIN = 0.999


@dataclass(frozen=True)
class WalkPoint:
    """The quality at one place of the walks."""

    pixel: float  # world units: the size of a pixel at what is nearest
    level: int  # that is shown there
    psnr_db: float  # of the mixture
    base_db: float  # of the base alone, as the viewer draws it
    splats: float  # that the mixture has, on average


@dataclass(frozen=True, eq=False)
class Seen:
    """What is seen from one place of a walk."""

    pixel: float  # world units: the size of a pixel at what is nearest
    way: float  # world units walked
    truth: Tensor  # [H, W, 3], as are the images
    mixture: Tensor
    base: Tensor
    splats: int  # of the mixture


class Walks:
    """Random walks backwards over levels."""

    def __init__(self, scene: DistanceScene, levels: Sequence[SplatModel]) -> None:
        generator = torch.Generator().manual_seed(derived_seed(int(scene.request.settings.get("seed", 0)), DRAW))
        around = with_company(scene.views, scene.base.viewpoints.orbit)
        seeing = [view for view in (*jittered(around, VIEWS, generator), *scene.views) if math.isfinite(self._depth(view, scene))]
        self.views = seeing[:VIEWS]
        self._truth = WalkTruth((scene.splats, scene.backend, scene.base.effects()), scene.views, {}, SAMPLES)
        self._scene, self._mixture = scene, Mixture.streamed(scene.rule, scene.extent, [scene.splats_of(model) for model in levels])

    @torch.no_grad()
    def seen(self, view: Camera, size: float) -> Seen:
        """Where a pixel at what is nearest has this size, or where the walk from a view begins."""
        depth, way = self._depth(view, self._scene), self._way(view, size)
        camera = backed(view, way)
        shown = self._mixture.splats(camera)
        truth, mixture, base = self._truth.make(camera, view), self._draw(shown, camera), self._draw(self._scene.splats, camera)
        return Seen((depth + way) / mean_focal(view), way, truth, mixture, base, len(shown))

    def sizes(self) -> list[float]:
        """Where walks are looked at, as rising sizes of a pixel at what is nearest: 0, where they begin, then the middle and the end of each level.

        Places before the beginning of all walks, where the first levels may end, are left out: they would show the same pictures again.
        """
        return [0.0, *(size for size in sizes(self._scene.rule) if any(self._way(view, size) for view in self.views))]

    def _way(self, view: Camera, size: float) -> float:
        """How far back, in world units, a pixel at what is nearest has this size; 0 where it has at least that as the walk begins."""
        return max(0.0, size * mean_focal(view) - self._depth(view, self._scene))

    @staticmethod
    def _depth(view: Camera, scene: DistanceScene) -> float:
        return foreground(view, scene.splats.means, scene.target.near_plane)

    def _draw(self, splats: Gaussians, camera: Camera) -> Tensor:
        return self._scene.backend.render(splats, camera, self._scene.target).image.clamp(0, 1)


def sizes(rule: DistanceRule) -> list[float]:
    """The middle and the end of each level, left out or not: sizes of a pixel at what is nearest, rising."""
    return [size for number in range(rule.count + rule.left_out) for size in (rule.middle(number), rule.ends(number)[1] * WITHIN)]


def measured(scene: DistanceScene, levels: Sequence[SplatModel]) -> list[WalkPoint]:
    """The quality at all places of the walks, in their order."""
    walks, points = Walks(scene, levels), []
    for size in walks.sizes():
        rows = [_compared(walks.seen(view, size)) for view in walks.views]
        nearest, dbs, base_dbs, counts = (fmean(column) for column in zip(*rows, strict=True))
        points.append(WalkPoint(nearest, int(scene.rule.level(torch.tensor([nearest]))), dbs, base_dbs, counts))
    return points


def _compared(seen: Seen) -> tuple[float, float, float, float]:
    """The size of a pixel, dB of the mixture and of the base, splats."""
    dbs = [decibel(float((image - seen.truth).square().mean())) for image in (seen.mixture, seen.base)]
    return seen.pixel, dbs[0], dbs[1], float(seen.splats)
