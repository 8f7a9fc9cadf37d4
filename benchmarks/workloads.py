"""What is measured on: raw parameters, one view and a loss, generated once and passed to every measuring process as a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch
from scenes import Name, make
from torch import Tensor

from mipmap_plugin import Camera, Effects, Gaussians, wrap_model
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.render_settings import MIN_ALPHA
from mipmap_plugin.screen_filters import DILATION
from mipmap_plugin.splatting.projection import project
from mipmap_plugin.splatting.rotations import rotations

# Splats counted at once, so that counting pairs takes little memory whatever the checkpoint.
CHUNK = 1 << 16

# Distance of the halves of a split splat from its center, in standard deviations.
APART = 0.5


@dataclass(frozen=True, eq=False)
class Workload:
    """From `raw` to the image of `camera`, and back from sum(image * weights)."""

    name: str
    raw: dict[str, Tensor]  # means [N, 3], log_scales [N, 3], quats [N, 4], logits [N], sh [N, K, 3]
    camera: Camera
    weights: Tensor  # [H, W, 3]
    pairs: int  # (splat, pixel) pairs whose alpha is at least 1/255

    def save(self, path: Path) -> None:
        torch.save(vars(self) | {"camera": {each.name: getattr(self.camera, each.name) for each in fields(Camera)}}, path)

    @classmethod
    def load(cls, path: Path) -> Workload:
        facts = torch.load(path, weights_only=True)
        return cls(**facts | {"camera": Camera(**facts["camera"])})


@dataclass(frozen=True, eq=False)
class Passes:
    """What is timed: from `raw` to an image, and back from sum(image * weights)."""

    raw: dict[str, Tensor]  # that require gradients
    weights: Tensor  # [H, W, 3]
    render: Callable[[Gaussians], Tensor]

    def forward(self) -> None:
        with torch.no_grad():
            self.render(activated(self.raw))

    def forward_backward(self) -> None:
        for leaf in self.raw.values():
            leaf.grad = None
        (self.render(activated(self.raw)) * self.weights).sum().backward()


@dataclass(frozen=True)
class Size:
    """How large a workload is."""

    name: str
    splats: int
    width: int  # px
    height: int  # px
    pairs: int


@dataclass(frozen=True)
class Variant:
    """What users have of a checkpoint: a student at the start of an adaptation, the base as its truth is drawn, or a larger stand-in."""

    checkpoint: Path
    scale: float = 1.0  # of the student, or of the truth
    student: bool = False
    splats: int | None = None  # split into so many


def users_scenes(data: Path) -> list[Variant]:
    """Students and bases at every zoom-out, a real capture, and a million splats; DATA as of `real_bases.py`."""
    bases = [data / "checkpoints" / "bases" / name for name in ("lego_200", "chair_400")]
    zoomed_out = [Variant(base, scale, student) for base in bases for scale in (1 / 2, 1 / 4, 1 / 8) for student in (True, False)]
    return [*zoomed_out, Variant(data / "checkpoints" / "flowers_r8"), Variant(bases[1], splats=1_000_000)]


def prepare(source: Name | Path | Variant, path: Path) -> Size:
    """Write the workload of a scene's name, of a checkpoint or of what users have of one to `path`."""
    if isinstance(source, Variant):
        workload = from_variant(source)
    elif isinstance(source, Path):
        workload = from_checkpoint(source)
    else:
        workload = from_scene(source)
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
    return of_gaussians(path.name, wrapped.model.gaussians(camera).detach(), camera)


def from_variant(variant: Variant) -> Workload:
    """The first view of the checkpoint, zoomed as in an adaptation: a truth has up to four times as many pixels as its target along each axis."""
    wrapped, name = wrap_model(variant.checkpoint), variant.checkpoint.name
    view = wrapped.views()[0]
    if variant.student:
        camera, model = view.zoomed(variant.scale), wrapped.adapt(variant.scale, steps=0, returns="last").model
        return of_gaussians(f"{name} student x{variant.scale:g}", model.gaussians(camera).detach(), camera)
    camera, gaussians = view.zoomed(min(1.0, 4 * variant.scale)), wrapped.model.gaussians(view).detach()
    if variant.splats is None:
        return of_gaussians(f"{name} base x{variant.scale:g}", gaussians, camera)
    return of_gaussians(f"{name} in {variant.splats:,}", split_into(gaussians, variant.splats), camera)


def split_into(gaussians: Gaussians, count: int) -> Gaussians:
    """Split splats in two along their longest axis, with mass, mean and covariance kept, until there are `count`: the most opaque first."""
    while len(gaussians) < count:
        order = gaussians.opacities.argsort(descending=True, stable=True)
        halved, rest = gaussians[order[: count - len(gaussians)]], gaussians[order[count - len(gaussians) :]]
        longest = torch.nn.functional.one_hot(halved.scales.argmax(1), 3)
        shorter = halved.scales * torch.where(longest > 0, (1 - APART**2) ** 0.5, 1.0)
        along = (rotations(halved.quats) @ (APART * halved.scales * longest)[..., None])[..., 0]
        opacities = halved.opacities / (2 * (1 - APART**2) ** 0.5)
        one, other = (replace(halved, means=halved.means + side * along, scales=shorter, opacities=opacities) for side in (-1, 1))
        gaussians = rest.joined(one).joined(other)
    return gaussians


def of_gaussians(name: str, gaussians: Gaussians, camera: Camera) -> Workload:
    if gaussians.covariances is not None:
        raise SettingsError(f"{name}: its family gives covariances, which have no raw parameters to measure from; take another checkpoint")
    raw = raw_of(gaussians)
    weights = torch.randn(*camera.size, 3, generator=torch.Generator().manual_seed(0))
    return Workload(name, raw, camera, weights, count_pairs(activated(raw), camera))


def raw_of(gaussians: Gaussians) -> dict[str, Tensor]:
    """The raw parameters of splats, of which `activated` makes them."""
    g = gaussians
    return {"means": g.means, "log_scales": g.scales.log(), "quats": g.quats, "logits": g.opacities.logit(eps=1e-6), "sh": g.sh}


def activated(raw: dict[str, Tensor]) -> Gaussians:
    return Gaussians(raw["means"], raw["quats"], raw["log_scales"].exp(), raw["logits"].sigmoid(), raw["sh"])


def effects_of(gaussians: Gaussians) -> Effects:
    """Classic dilation, black background, every SH band: what all programs have in common."""
    return Effects(sh_degree=gaussians.sh_degree)


def count_pairs(gaussians: Gaussians, camera: Camera) -> int:
    """(splat, pixel) pairs with alpha of at least 1/255, whether or not the pixel is opaque before."""
    gaussians, near = gaussians.to(dtype=torch.float64), effects_of(gaussians).near_plane
    bright = (gaussians.opacities >= MIN_ALPHA).nonzero()[:, 0]
    return sum(_pairs_of(gaussians[rows], camera, near) for rows in bright.split(CHUNK))


def _pairs_of(gaussians: Gaussians, camera: Camera, near: float) -> int:
    """Pixel centers inside each ellipse, image row by image row."""
    splats = project(gaussians, camera, near)
    xx, yy = splats.xx + DILATION, splats.yy + DILATION
    x, y = splats.means2d.unbind(1)
    reach = 2 * (gaussians.opacities / MIN_ALPHA).log()
    half = (reach * yy).sqrt()
    first = (y - half - 0.5).ceil().clamp(0, camera.height).long()
    last = (y + half - 0.5).floor().clamp(-1, camera.height - 1).long()
    rows = torch.where(splats.depths > near, (last - first + 1).clamp_min(0), 0)

    ids = torch.arange(len(rows)).repeat_interleave(rows)
    nth = torch.arange(len(ids)) - (rows.cumsum(0) - rows)[ids]
    dy = first[ids] + nth + 0.5 - y[ids]
    across = (xx - splats.xy.square() / yy)[ids] * (reach[ids] - dy.square() / yy[ids])
    middle, width = x[ids] + (splats.xy / yy)[ids] * dy, across.clamp_min(0).sqrt()
    left, right = (middle - width - 0.5).ceil().clamp_min(0), (middle + width - 0.5).floor().clamp_max(camera.width - 1)
    return int((right - left + 1).clamp_min(0).sum())
