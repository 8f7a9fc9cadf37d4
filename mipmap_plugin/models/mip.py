"""Families whose PLY has a column `filter_3D`: Mip-Splatting, Gaussian Opacity Fields and Analytic-Splatting.

Everything else is stored as in 3DGS. The 3D filter keeps splats from being thinner than the training cameras resolved. It is a constant
of each row: scales and opacities were optimized with it, so another value would change the image. Before further training the original
project recomputes it itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import NEAR_PLANE, Effect
from mipmap_plugin.errors import CheckpointError, ShapeError, plural, some_of
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import CARRIED, TrainedScale, Traits
from mipmap_plugin.models.columns import FILTER_3D as COLUMN
from mipmap_plugin.models.detect import detect_as
from mipmap_plugin.models.health import LARGEST
from mipmap_plugin.models.outputs import finite
from mipmap_plugin.models.reading import drop, read_splats
from mipmap_plugin.models.vanilla import VanillaModel

# Screen filter of each family, and its dilation in px² if no cfg_args gives the kernel_size.
FAMILY_FILTERS = {"mip": ("mip", 0.1), "gof": ("mip", 0.0), "analytic": ("analytic", 0.0)}

NOTES = {
    "mip": [],
    "gof": ["Gaussian Opacity Fields evaluates splats along rays in 3D; here they are projected first (EWA), which is close but not the same"],
    "analytic": [f"{COLUMN} is kept but not applied: Analytic-Splatting uses it only with its flag --filter3d, which no file records"],
}

# Mip-Splatting's compute_3D_filter: the variance in px² at the finest sampling, and how far outside the image a center may lie.
FILTER_VARIANCE = 0.2
FRAME_MARGIN = 0.15  # of the width and the height


class MipModel:
    """Splats of 3DGS, each smoothed by its own 3D filter; into new shapes that is baked, and it is 0.

    Parameters: those of `VanillaModel`, and the filters [N] in world units, which are never optimized.
    """

    def __init__(self, family: str, splats: VanillaModel, filter_3d: Tensor) -> None:
        """A model over these tensors, which are not copied. Raises ShapeError."""
        if filter_3d.shape != (len(splats),):
            raise ShapeError(f"{COLUMN}: expected shape [{len(splats)}], got {list(filter_3d.shape)}")
        self.family, self.splats, self.filter_3d = family, splats, filter_3d
        self.source, self.folder, self.digest, self.notes = splats.source, splats.folder, splats.digest, splats.notes

    @property
    def trained(self) -> TrainedScale:
        return self.splats.trained

    @trained.setter
    def trained(self, trained: TrainedScale) -> None:
        self.splats.trained = trained

    def __len__(self) -> int:
        return len(self.splats)

    @property
    def traits(self) -> Traits:
        on, reason = self._smooths, f"the file gives one for each of {plural(len(self), 'splat')}"
        if not on:
            reason = "the file gives one, but its project does not apply it"
        elif not self.filter_3d.any():
            on, reason = False, "the file gives one, but it is 0 for every splat"
        effect = Effect("3D filter", on, reason, "three roots a splat")
        return Traits(same_for_all_views=True, filtered=True, exposures=self.splats.traits.exposures, effects=(effect,))

    def gaussians(self, camera: Camera | None = None) -> Gaussians:
        """All splats, activated and smoothed. `camera` is ignored."""
        raw = self.splats.gaussians(camera)
        if not self._smooths:
            return raw
        scales, opacities = smooth_3d(raw.scales, raw.opacities, self.filter_3d.detach())
        return replace(raw, scales=scales, opacities=opacities)

    def parameters(self) -> dict[str, Tensor]:
        return {**self.splats.parameters(), CARRIED: self.filter_3d}

    def shared_parameters(self) -> dict[str, Tensor]:
        """None: every parameter belongs to a splat."""
        return {}

    def copy(self) -> MipModel:
        return MipModel(self.family, self.splats.copy(), self.filter_3d.detach().clone().requires_grad_())

    def to(self, device: torch.device | str) -> MipModel:
        return MipModel(self.family, self.splats.to(device), self.filter_3d.detach().to(device, copy=True))

    def replace_parameters(self, parameters: dict[str, Tensor]) -> None:
        self.splats.replace_parameters({name: tensor for name, tensor in parameters.items() if name != CARRIED})
        self.filter_3d = parameters[CARRIED]

    def reshape(self, form: Callable[[Gaussians], tuple[Tensor, Tensor]], views: Sequence[Camera] = ()) -> None:
        """Give the smoothed splats the scales [N, 3] and opacities [N] that `form` returns. Their filter is 0 then, for they may be thinner."""
        scales, opacities = form(self.gaussians().detach())
        self.splats.reshape(lambda _: (scales, opacities))
        if self._smooths:
            self.filter_3d = torch.zeros_like(self.filter_3d).requires_grad_()

    def rebuild(self, form: Callable[[Gaussians], Gaussians]) -> None:
        """Replace the smoothed splats by those that `form` returns for them, of any number, whose filters are 0."""
        before = self.gaussians().detach()
        after = form(before)
        if after is not before:
            self.splats.rebuild(lambda _: after)
            self.filter_3d = torch.zeros_like(after.opacities).requires_grad_()

    def row_opacities(self, views: Sequence[Camera] = ()) -> Tensor:
        return self.gaussians().opacities.detach()

    def refuse_output(self, path: Path, *, overwrite: bool, networks_move: bool = False) -> None:
        """As `VanillaModel.refuse_output`."""
        self.splats.refuse_output(path, overwrite=overwrite)

    def bare(self) -> VanillaModel:
        """The splats, sharing tensors, as a viewer reads them that ignores the column filter_3D."""
        plain = self.splats.with_extras(self.splats.extras)
        plain.trained = replace(self.trained, keeps_filter=False)
        return plain

    def fused(self) -> VanillaModel:
        """Splats of 3DGS into which the 3D filter is baked: under the screen filter of training they render the same."""
        plain = self.bare().copy()
        if self._smooths:
            smoothed = self.gaussians().detach()
            plain.reshape(lambda _: (smoothed.scales, smoothed.opacities))
        for tensor in plain.parameters().values():
            tensor.requires_grad_(False)
        plain.digest = self.digest  # a report names the file that its base was read from
        return plain

    def save(self, path: str | Path, *, provenance: dict[str, Any], overwrite: bool = False) -> Path:
        """Write a PLY or a model folder as `VanillaModel.save` does, with filter_3D as the last column. Raises OutputExists."""
        finite({**self.splats.parameters(), CARRIED: self.filter_3d}, LARGEST)  # raises for the filter too
        filter_3d = self.filter_3d.detach().to("cpu", torch.float32).numpy()
        provenance = {**provenance, "family": self.family, "kernel_size": self.trained.eps2d}  # a bare PLY has no cfg_args
        return self.splats.with_extras({**self.splats.extras, COLUMN: filter_3d}).save(path, provenance=provenance, overwrite=overwrite)

    @property
    def _smooths(self) -> bool:
        return self.family != "analytic"


def load_mip(path: str | Path, *, iteration: int | None = None) -> MipModel:
    """Load a PLY with `filter_3D`, or the model folder around one. Splats that are not finite are dropped, with a note.

    Raises CheckpointError for a path that is damaged, of another family, or not a checkpoint.
    """
    checkpoint = detect_as(path, tuple(FAMILY_FILTERS), iteration=iteration)
    splats = read_splats(checkpoint, VanillaModel)
    invalid = torch.from_numpy(~((splats.extras[COLUMN] >= 0) & (splats.extras[COLUMN] <= LARGEST)))
    if invalid.all():
        raise CheckpointError(f"{checkpoint.path}: {some_of(0, len(splats), 'splat', 'have')} a valid {COLUMN}; export it again")
    if invalid.any():
        splats = drop(splats, invalid, f"an invalid {COLUMN}", checkpoint.path)
    filter_3d = torch.from_numpy(splats.extras[COLUMN]).float()
    splats = splats.with_extras({name: column for name, column in splats.extras.items() if name != COLUMN})
    splats.trained = _trained(checkpoint.family, splats.trained)
    splats.notes += NOTES[checkpoint.family]
    return MipModel(checkpoint.family, splats, filter_3d)


def smooth_3d(scales: Tensor, opacities: Tensor, filter_3d: Tensor) -> tuple[Tensor, Tensor]:
    """Scales [N, 3] and opacities [N] after the 3D filter [N] of Mip-Splatting: splats convolved with an isotropic Gaussian, mass preserved.

    s' = sqrt(s² + f²) and o' = o · Π s / s', as a product of ratios, since Πs² / Πs'² may under- or overflow.
    """
    scales = scales.clamp_min(torch.finfo(scales.dtype).tiny)  # the root's gradient at 0² + 0² is infinite
    smoothed = torch.hypot(scales, filter_3d[:, None])
    return smoothed, opacities * (scales / smoothed).prod(dim=1)


def filter_3d_of(means: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Mip-Splatting's 3D filter [N], world units, for splats at `means` [N, 3] and the training `cameras` (compute_3D_filter).

    z/f·sqrt(0.2), where z is the least depth among the cameras that see the center, and f the longest focal length of all cameras;
    a center that no camera sees gets the largest z. Raises CheckpointError if no camera sees any center.
    """
    nearest = torch.full_like(means[:, 0], torch.inf)
    for camera in cameras:
        x, y, z = camera.to_camera(means).unbind(-1)
        across, down = (camera.fx * x / z + camera.cx) / camera.width, (camera.fy * y / z + camera.cy) / camera.height
        inside = (torch.stack([across, down]) - 0.5).abs().amax(0) <= 0.5 + FRAME_MARGIN
        nearest = torch.where((z > NEAR_PLANE) & inside, torch.minimum(nearest, z), nearest)
    seen = nearest.isfinite()
    if not seen.any():
        raise CheckpointError("no training camera sees a splat, so the 3D filter is undefined; give the cameras that it was trained with")
    depth, deviation = torch.where(seen, nearest, nearest[seen].max()), float(FILTER_VARIANCE**0.5)
    return depth / max(camera.fx for camera in cameras) * deviation


def _trained(family: str, trained: TrainedScale) -> TrainedScale:
    """`trained` with the family's screen filter, which a file with the column keeps: only its own project renders it right."""
    screen_filter, eps2d = FAMILY_FILTERS[family]
    eps2d = trained.eps2d if trained.screen_filter == screen_filter else eps2d
    return replace(trained, screen_filter=screen_filter, eps2d=eps2d, keeps_filter=True)
