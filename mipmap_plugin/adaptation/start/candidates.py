"""What a run begins with: the best, on validation views, of the base as it is, the closed form, and the closed form of merged splats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import cast

import torch
from torch import Tensor

from mipmap_plugin.adaptation.start.blend_weights import light
from mipmap_plugin.adaptation.start.closed_form import AREA_POWER, Form, closed_form, needs_nothing, pixel_size
from mipmap_plugin.adaptation.start.matching import matched
from mipmap_plugin.adaptation.start.merging import merge
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import Rebuilt, SplatModel

# Views that tell how much of the base's images each splat makes up.
WEIGHED_VIEWS = 12


@dataclass(frozen=True, eq=False)
class Problem:
    """What a start is wanted for."""

    base: Callable[[], SplatModel]  # a copy of the base, to be rendered as the target is
    views: Sequence[Camera]  # at the base scale
    scale: float
    trained: Effects  # how the base is rendered
    aim: Effects  # how the adapted file is
    config: AdaptConfig
    backend: Backend
    weighs: bool  # whether splats are the same for all views, and the backend tells how much of an image each makes up
    steer: Callable[[SplatModel], float]  # dB of a model on the views that steer the run
    phase: Callable[[str], AbstractContextManager[None]]  # bills what is done inside to a phase of that name


class Start:
    """The candidates, and the choice among them."""

    def __init__(self, problem: Problem) -> None:
        self._of, self._views = problem, evenly(problem.views, WEIGHED_VIEWS)
        filters_do_it = needs_nothing(problem.scale, problem.trained, problem.aim)
        self._weighs = problem.weighs and problem.scale <= 1 and not filters_do_it

    @torch.no_grad()
    def best(self) -> tuple[SplatModel, str]:
        """A model to begin with, and what it is."""
        of, config, base = self._of, self._of.config, self._of.base()
        if not (config.closed_form or config.merge_to < 1):
            return base, "the base"
        with of.phase("blend weights"):
            weights = self._weights(base) if self._weighs or config.merge_to < 1 else None
        formed = self._formed(weights, 1.0)
        if config.merge_to == 1 and config.returns == "last":
            return formed, "the closed form"
        found, least = of.steer(base), of.steer(formed)
        for share in (config.merge_to ** (1 / part) for part in (1, 2, 4)) if config.merge_to < 1 else ():
            merged = self._formed(weights, share)
            if (judged := of.steer(merged)) >= least - config.merging_costs:
                return (merged, "the closed form of merged splats") if judged >= found else (base, "the base")
        return (formed, "the closed form") if least >= found else (base, "the base")

    def _formed(self, weights: Tensor | None, share: float) -> SplatModel:
        """The base with `share` of its splats left, in closed form."""
        of, student = self._of, self._of.base()
        if share < 1 and weights is not None:
            with of.phase("merging"):
                weights = self._merge(student, weights, share)
        if of.config.closed_form:
            with of.phase("closed form"):
                student.reshape(lambda gaussians: self._form(gaussians, weights), of.views)
        return student

    def _merge(self, student: SplatModel, weights: Tensor, share: float) -> Tensor:
        """Leave `share` of the splats; what each that is left fills."""
        filled = []

        def fewer(gaussians: Gaussians) -> Gaussians:
            merged, light = merge(gaussians, pixel_size(gaussians.means, self._of.views) / self._of.scale, weights, share)
            filled.append(light)
            return merged

        cast(Rebuilt, student).rebuild(fewer)
        return filled[0]

    def _form(self, gaussians: Gaussians, weights: Tensor | None) -> tuple[Tensor, Tensor]:
        of = self._of
        form = Form(1.0 if self._weighs else AREA_POWER, of.config.crispness)
        scales, opacities = closed_form(gaussians, of.views, of.scale, of.trained, of.aim, form)
        if not self._weighs or weights is None:
            return scales, opacities
        views = [view.zoomed(of.scale) for view in self._views]

        def weigh(tried: Tensor) -> Tensor:
            return light(replace(gaussians, scales=scales, opacities=tried), views, of.backend, of.aim)

        return scales, matched(opacities, weights, weigh)

    def _weights(self, base: SplatModel) -> Tensor:
        """[N] target pixels that each of the base's splats fills in a view."""
        gaussians = base.gaussians(self._views[0]).detach()
        return light(gaussians, self._views, self._of.backend, self._of.trained) * self._of.scale**2


def warm(backend: Backend, gaussians: Gaussians, effects: Sequence[Effects], *, gradients: bool) -> None:
    """Have the backend compile what it will be asked for, on one splat, so that no later phase is billed for it."""
    camera = Camera(1, 1, 1.0, 1.0, 0.5, 0.5, torch.eye(4))
    for each in effects:
        one = gaussians[torch.arange(min(1, len(gaussians)))].detach()
        one.means.requires_grad_(gradients)
        image = backend.render(one, camera, each).image
        if gradients and image.requires_grad:
            image.sum().backward()
