"""Steps over the splats of 3DGS: views are drawn and differentiated, in threads if wanted, and one kernel moves what they are drawn from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.backends.base import AdamStep, Rendered
from mipmap_plugin.backends.cpu_kernels import ahead, descending, drawing
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians

# Raises BackendUnavailable for splats and effects that cannot be drawn.
Require = Callable[[Gaussians, Effects], None]

# Splats, a camera and effects -> the splats' ranks, by which they are sorted; None where that is by their depths.
Ranks = Callable[[Gaussians, Camera, Effects], Any]


class CpuStepper:
    """See `base.Stepper`. It keeps the activated splats from step to step: the kernel that moves a row activates it anew."""

    def __init__(self, raw: Mapping[str, Tensor], require: Require, ranks: Ranks) -> None:
        self._splats, self._require, self._ranks = descending.activated(raw), require, ranks
        self._gaussians = Gaussians(*(torch.from_numpy(array) for array in self._splats[:-1]))  # without covariances
        self._projected: dict[tuple[int, Camera], drawing.Projection] = {}  # the views of a step, by their numbers
        self._drawn: dict[int, drawing.Drawing] = {}  # and what is drawn of them
        self._tables: dict[int, np.ndarray] = {}  # and their gradient tables

    def prepare(self, shots: Sequence[tuple[Camera, Effects]]) -> None:
        """Project the splats into all views: each thread those that it will move, for what another core writes takes long to read."""
        projected = drawing.project(self._splats, [self._shot(*shot) for shot in shots])
        self._projected = {(number, each.shot.camera): each for number, each in enumerate(projected)}

    def _shot(self, camera: Camera, effects: Effects) -> drawing.Shot:
        self._require(self._gaussians, effects)
        ahead.start(False, effects)  # the backward pass is compiled while the forward pass is
        return drawing.Shot(camera, effects, self._ranks(self._gaussians, camera, effects))

    def render(self, number: int, camera: Camera, effects: Effects) -> Rendered:
        projected = self._projected.pop((number, camera), None)
        [drawn] = drawing.draw(self._splats, [self._shot(camera, effects)]) if projected is None else drawing.draw_projected([projected])
        ahead.wait(False, effects)
        self._drawn[number] = drawn
        return Rendered(torch.from_numpy(drawn.image), torch.from_numpy(drawn.alpha))

    def differentiate(self, number: int, d_image: Tensor, d_alpha: Tensor | None = None) -> None:
        drawn = self._drawn[number]
        outputs = d_image.contiguous().numpy(), np.zeros(drawn.alpha.shape, np.float32) if d_alpha is None else d_alpha.contiguous().numpy()
        [self._tables[number]] = drawing.tile_gradients([drawn], [outputs])

    def step(self, step: AdamStep) -> None:
        if not self._tables:
            raise RuntimeError("a step needs the gradient of an image; call differentiate() first")
        views = [(self._drawn[number], self._tables[number]) for number in sorted(self._tables)]
        self._projected.clear()
        self._drawn.clear()
        self._tables.clear()
        descending.descend(self._splats, views, step)
