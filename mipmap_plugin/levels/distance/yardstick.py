"""What levels by distance are measured by: walks that no level was adapted to, drawn as the viewer mixes the levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import torch

from mipmap_plugin.adaptation.curve import decibel
from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.levels.distance.level import MEASURED_SAMPLES, Scene
from mipmap_plugin.levels.distance.mixture import Mixture
from mipmap_plugin.levels.distance.walks import WalkTruth, backed, focal_of, foreground
from mipmap_plugin.levels.yardstick import DRAW, VIEWS
from mipmap_plugin.limits import derived_seed
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.scenes.trajectories import jittered

TRUTH = (
    f"mean PSNR over {VIEWS} random walks backwards that no level was adapted to, levels chosen by chunk, against the base with "
    f"{MEASURED_SAMPLES} x {MEASURED_SAMPLES} samples a pixel, its dilation as large in the world as where the walk begins"
)


@dataclass(frozen=True)
class WalkPoint:
    """The quality at one place of the walks."""

    pixel: float  # world units: the size of a pixel at what is nearest
    level: int  # that is shown there
    psnr_db: float  # of the mixture
    base_db: float  # of the base alone, as the viewer draws it
    splats: float  # that the mixture has, on average


@torch.no_grad()
def measured(scene: Scene, levels: Sequence[SplatModel]) -> list[WalkPoint]:
    """The quality where the walks begin, and where what is nearest is in the middle of each level and at its end."""
    generator = torch.Generator().manual_seed(derived_seed(int(scene.request.settings.get("seed", 0)), DRAW))
    views = jittered(scene.views, VIEWS, generator)
    truth = WalkTruth((scene.splats, scene.backend, scene.base.effects()), scene.views, {}, MEASURED_SAMPLES)
    mixture = Mixture.of(scene.rule, scene.chunks, [model.gaussians(scene.base.any_camera()).detach() for model in levels])
    rule = scene.rule
    sizes = [0.0, *(size for number in range(rule.count) for size in (rule.ends(number)[1] / rule.ratio**0.5, rule.ends(number)[1] * 0.999))]
    points = []
    for size in sizes:
        rows = [_compared(scene, mixture, truth, view, size) for view in views]
        nearest, dbs, base_dbs, counts = (fmean(column) for column in zip(*rows, strict=True))
        points.append(WalkPoint(nearest, int(rule.level(torch.tensor([nearest]))), dbs, base_dbs, counts))
    return sorted(points, key=lambda point: point.pixel)


def _compared(scene: Scene, mixture: Mixture, truth: WalkTruth, view: Camera, size: float) -> tuple[float, float, float, float]:
    """Where a pixel at what is nearest has this size, or where the walk begins: that size, dB of the mixture and of the base, splats."""
    depth = foreground(view, scene.splats.means, scene.target.near_plane)
    way = max(0.0, size * focal_of(view) - depth)
    camera = backed(view, way)
    right, shown = truth.make(camera, view), mixture.splats(camera)

    def psnr(splats: Gaussians) -> float:
        image = scene.backend.render(splats, camera, scene.target).image.clamp(0, 1)
        return decibel(float((image - right).square().mean()))

    return (depth + way) / focal_of(view), psnr(shown), psnr(scene.splats), float(len(shown))
