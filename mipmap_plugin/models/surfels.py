"""2D Gaussian Splatting (Huang et al. 2024) and its descendants: flat splats that rays intersect (`splatting.surfels`).

Everything but the third scale is stored as in 3DGS. An adapted file is for the original project, and keeps its screen filter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import LOW_PASS, SURFEL
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.columns import SCALE, to_parameters
from mipmap_plugin.models.detect import detect_as
from mipmap_plugin.models.raw import MIN_SCALE
from mipmap_plugin.models.reading import read_splats
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.splatting.rotations import quaternion_product

# Stands for the log of a third scale of 0; files do not contain it.
FLAT = float(torch.tensor(MIN_SCALE, dtype=torch.float32, device="cpu").log())

NOTE = "its splats are flat (2DGS): only the reference backend draws them so, and only viewers of 2DGS show the adapted file right"

# Quaternions that rotate the first, second or third axis to the third; the axes are permuted cyclically.
TO_THIRD = ((0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1.0, 0.0, 0.0, 0.0))


class SurfelModel(VanillaModel):
    """N flat splats. Parameters are those of `VanillaModel`; the third log scale is kept but has no effect."""

    family = "2dgs"
    _no_viewer = "its splats are flat (2DGS), which none of the viewers draws"

    def _activated(self, sh: Tensor) -> Gaussians:
        """All splats, with third scales of 0."""
        thick = super()._activated(sh)
        return replace(thick, scales=thick.scales * thick.scales.new_tensor([1.0, 1.0, 0.0]))

    def reshape(self, form: Callable[[Gaussians], tuple[Tensor, Tensor]], views: Sequence[Camera] = ()) -> None:
        """Set the first two scales and the opacities that `form` returns, in place. Raises ShapeError."""
        third = self._parameters["scales"][:, 2].detach().clone()
        super().reshape(form, views)
        with torch.no_grad():
            self._parameters["scales"][:, 2] = third

    def rebuild(self, form: Callable[[Gaussians], Gaussians]) -> None:
        """Replace the splats by those that `form` returns for them, flattened along their shortest axes."""
        super().rebuild(lambda gaussians: flattened(form(gaussians)))

    @staticmethod
    def parameters_of(columns: Mapping[str, np.ndarray], path: Path) -> dict[str, Tensor]:
        count = len(columns[SCALE[0]])
        return to_parameters({SCALE[2]: np.full(count, FLAT, np.float32), **columns}, path)

    def _columns(self, parameters: dict[str, Tensor]) -> dict[str, np.ndarray]:
        columns = super()._columns(parameters)
        if (columns[SCALE[2]] <= FLAT + 1).all():  # rounding aside
            del columns[SCALE[2]]
        return columns


def load_surfels(path: str | Path, *, iteration: int | None = None) -> SurfelModel:
    """Load a PLY or model folder of 2DGS. Splats that are not finite once activated are dropped, with a note.

    Raises CheckpointError for a path that is damaged, of another family, or not a checkpoint.
    """
    model = read_splats(detect_as(path, ("2dgs",), iteration=iteration), SurfelModel)
    model.trained = flat_trained(model.trained)
    model.notes.append(NOTE)
    return model


def flat_trained(trained: TrainedScale) -> TrainedScale:
    """`trained` with the screen filter of surfels."""
    return replace(trained, screen_filter=SURFEL, eps2d=LOW_PASS, keeps_filter=True)


def flattened(gaussians: Gaussians) -> Gaussians:
    """The splats with axes permuted so that the shortest is the third, whose scale becomes 0. Splats that are flat already do not change."""
    thick = gaussians.scales[:, 2] != 0
    if not thick.any():
        return gaussians
    shortest = gaussians.scales.argmin(dim=1)
    turn = gaussians.quats.new_tensor(TO_THIRD)[shortest]
    quats = torch.where(thick[:, None], quaternion_product(gaussians.quats, turn), gaussians.quats)
    order = (shortest[:, None] + shortest.new_tensor([1, 2, 0])) % 3
    scales = torch.where(thick[:, None], gaussians.scales.gather(1, order), gaussians.scales)
    return replace(gaussians, quats=quats, scales=scales * scales.new_tensor([1.0, 1.0, 0.0]))
