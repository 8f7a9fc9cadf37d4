"""2D Gaussian Splatting (Huang et al. 2024) and its descendants: splats without thickness, which rays meet (`splatting.surfels`).

Everything but the third scale is stored as 3DGS does. An adapted file is for the project that it came from, and keeps its filter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import LOW_PASS, SURFEL
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.columns import SCALE, to_parameters
from mipmap_plugin.models.detect import detect_as
from mipmap_plugin.models.vanilla import MIN_SCALE, VanillaModel, read_splats
from mipmap_plugin.splatting.rotations import quaternion_product

# The log scale that stands for no thickness, which no file holds.
FLAT = float(torch.tensor(MIN_SCALE).log())

NOTE = "its splats are flat and met by rays (2DGS): only the reference backend draws them so, and only viewers of 2DGS show the adapted file right"

# Quaternions that turn an axis into the third: the first, the second, the third itself. They exchange axes in a circle.
TO_THIRD = ((0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1.0, 0.0, 0.0, 0.0))


class SurfelModel(VanillaModel):
    """N flat splats. Parameters are `VanillaModel`'s; the third log scale is carried and means nothing."""

    family = "2dgs"
    _no_viewer = "its splats are flat and met by rays (2DGS), which no viewer of the list does"

    def gaussians(self, camera: Camera | None = None) -> Gaussians:
        """All splats, activated, with third scales of 0. `camera` is not looked at."""
        held = super().gaussians(camera)
        return replace(held, scales=held.scales * held.scales.new_tensor([1.0, 1.0, 0.0]))

    def reshape(self, form: Callable[[Gaussians], tuple[Tensor, Tensor]], views: Sequence[Camera] = ()) -> None:
        """Set the first two scales and the opacities that `form` finds, in place. Raises ShapeError."""
        third = self._parameters["scales"][:, 2].detach().clone()
        super().reshape(form, views)
        with torch.no_grad():
            self._parameters["scales"][:, 2] = third

    def rebuild(self, form: Callable[[Gaussians], Gaussians]) -> None:
        """Hold the splats that `form` makes of these, without their shortest axes."""
        super().rebuild(lambda held: flattened(form(held)))

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

    Raises CheckpointError for what is damaged, of another family, or no checkpoint.
    """
    model = read_splats(detect_as(path, ("2dgs",), iteration=iteration), SurfelModel)
    model.trained = flat_trained(model.trained)
    model.notes.append(NOTE)
    return model


def flat_trained(told: TrainedScale, **changes: Any) -> TrainedScale:
    """How a training of surfels sees: as `told`, but for the filter, which is always that of the family."""
    return replace(told, screen_filter=SURFEL, eps2d=LOW_PASS, keeps_filter=True, **changes)


def flattened(gaussians: Gaussians) -> Gaussians:
    """The splats turned so that their shortest axes are the third, and without it; those that have none stay bit by bit."""
    thick = gaussians.scales[:, 2] != 0
    if not thick.any():
        return gaussians
    shortest = gaussians.scales.argmin(dim=1)
    turn = gaussians.quats.new_tensor(TO_THIRD)[shortest]
    quats = torch.where(thick[:, None], quaternion_product(gaussians.quats, turn), gaussians.quats)
    order = (shortest[:, None] + shortest.new_tensor([1, 2, 0])) % 3
    scales = torch.where(thick[:, None], gaussians.scales.gather(1, order), gaussians.scales)
    return replace(gaussians, quats=quats, scales=scales * scales.new_tensor([1.0, 1.0, 0.0]))
