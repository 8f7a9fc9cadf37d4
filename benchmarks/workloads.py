"""What is measured on: raw parameters, one view and a loss, made once and handed to every measuring process as a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from scenes import Name, make
from torch import Tensor

from mipmap_plugin import Camera, Effects, Gaussians, wrap_model
from mipmap_plugin.backends.compositing import MIN_ALPHA
from mipmap_plugin.backends.filters import Footprint, footprint
from mipmap_plugin.backends.projection import project
from mipmap_plugin.backends.reference import drawn_rows, extents
from mipmap_plugin.errors import SettingsError

# Splats counted at once, so that counting pairs takes little memory whatever the checkpoint.
CHUNK = 1 << 16


@dataclass(frozen=True, eq=False)
class Workload:
    """From `raw` to the image of `camera`, and back from sum(image * weights)."""

    name: str
    raw: dict[str, Tensor]  # means [N, 3], log_scales [N, 3], quats [N, 4], logits [N], sh [N, K, 3]
    camera: Camera
    weights: Tensor  # [H, W, 3]
    pairs: int  # (splat, pixel) pairs whose alpha is at least 1/255

    def save(self, path: Path) -> None:
        torch.save(vars(self) | {"camera": vars(self.camera)}, path)

    @classmethod
    def load(cls, path: Path) -> Workload:
        facts = torch.load(path, weights_only=True)
        return cls(**facts | {"camera": Camera(**facts["camera"])})


@dataclass(frozen=True)
class Size:
    """How large a workload is."""

    name: str
    splats: int
    width: int  # px
    height: int  # px
    pairs: int


def prepare(source: Name | Path, path: Path) -> Size:
    """Write the workload of a scene's name or of a checkpoint to `path`."""
    workload = from_checkpoint(source) if isinstance(source, Path) else from_scene(source)
    workload.save(path)
    camera = workload.camera
    return Size(workload.name, len(workload.raw["means"]), camera.width, camera.height, workload.pairs)


def from_scene(name: Name) -> Workload:
    scene = make(name)
    raw = {key: torch.from_numpy(array) for key, array in scene.raw.items()}
    return Workload(name, raw, scene.camera, torch.from_numpy(scene.weights), count_pairs(activated(raw), scene.camera))


def from_checkpoint(path: Path) -> Workload:
    """The first view of a checkpoint, its own or of the orbit that is generated where it has none."""
    wrapped = wrap_model(path)
    camera = wrapped.views()[0]
    gaussians = wrapped.model.gaussians(camera).detach()
    if gaussians.covariances is not None:
        raise SettingsError(f"{path}: its family gives covariances, which have no raw parameters to measure from; take another checkpoint")
    raw = {
        "means": gaussians.means, "log_scales": gaussians.scales.log(), "quats": gaussians.quats,
        "logits": gaussians.opacities.logit(eps=1e-6), "sh": gaussians.sh,
    }  # fmt: skip
    weights = torch.randn(*camera.size, 3, generator=torch.Generator().manual_seed(0))
    return Workload(path.name, raw, camera, weights, count_pairs(activated(raw), camera))


def activated(raw: dict[str, Tensor]) -> Gaussians:
    return Gaussians(raw["means"], raw["quats"], raw["log_scales"].exp(), raw["logits"].sigmoid(), raw["sh"])


def effects_of(gaussians: Gaussians) -> Effects:
    """Classic dilation, black background, every SH band: what all programs have in common."""
    return Effects(sh_degree=gaussians.sh_degree)


def count_pairs(gaussians: Gaussians, camera: Camera) -> int:
    """(splat, pixel) pairs with alpha of at least 1/255, whether or not the pixel is opaque before."""
    gaussians, effects = gaussians.to(dtype=torch.float64), effects_of(gaussians)
    count = 0
    for rows in drawn_rows(gaussians, camera, effects).split(CHUNK):
        projected = project(gaussians[rows], camera, effects.near_plane)
        feet = footprint(projected, gaussians.opacities[rows], effects.screen_filter, effects.eps2d)
        count += _pairs_of(projected.means2d, feet, camera)
    return count


def _pairs_of(means2d: Tensor, feet: Footprint, camera: Camera) -> int:
    """Pixel centers inside each ellipse, image row by image row."""
    y, half = means2d[:, 1], extents(feet)[:, 1]
    first = (y - half - 0.5).ceil().clamp_min(0).long()
    last = (y + half - 0.5).floor().clamp_max(camera.height - 1).long()
    rows = (last - first + 1).clamp_min(0)
    splat = torch.arange(len(rows)).repeat_interleave(rows)
    nth = torch.arange(len(splat)) - (rows.cumsum(0) - rows)[splat]
    dy = first[splat] + nth + 0.5 - y[splat]
    reach = 2 * (feet.opacities / MIN_ALPHA).log()[splat]
    across = (feet.across[splat] * (reach - dy.square() / feet.yy[splat]).clamp_min(0)).sqrt()
    x = means2d[splat, 0] + feet.shear[splat] * dy
    left, right = (x - across - 0.5).ceil().clamp_min(0), (x + across - 0.5).floor().clamp_max(camera.width - 1)
    return int((right - left + 1).clamp_min(0).sum())
