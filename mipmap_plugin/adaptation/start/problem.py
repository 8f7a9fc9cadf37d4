"""The request for a start: the base, the target, and what measures the candidates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

from mipmap_plugin.adaptation.optimization.validation import Quality
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.models.base import SplatModel


@dataclass(frozen=True, eq=False)
class FinerLevel:
    """A model for the same viewer to start from instead of from the base: at a finer scale than the wanted one, or before a zoom-in at x1."""

    model: SplatModel
    scale: float
    name: str = "the finer level"  # what it is called in the report
    converts: bool = False  # it is the conversion at x1 before a zoom-in; what its views show of the base was told when it was made
    learned: bool = True  # steps have bettered it: in a time budget that has no time for two starts, it is worth more than the base


@dataclass(frozen=True, eq=False)
class StartProblem:
    """What a start is searched for and with."""

    base: Callable[[], SplatModel]  # makes a copy of the base that is rendered with the target's screen filter; it may share the base's tensors
    views: Sequence[Camera]  # at the base scale
    closest_of: Sequence[Camera]  # of the base scale: those among which the closest view of a splat is looked for
    scale: float
    base_effects: Effects  # how the base is rendered
    target: Effects  # how the adapted file is rendered
    config: AdaptConfig
    backend: Backend
    has_blend_weights: bool  # whether splats are the same for all views, and the backend has the gradients that blend weights need
    quality: Callable[[SplatModel], Quality]  # of a model on the views that steer the run
    phase: Callable[[str], AbstractContextManager[None]]  # counts the seconds spent inside under a phase of that name
    name: str = "the base"  # what the base is called in the report
    may_lose: float = 0.0  # dB by which merged splats may be worse than the base as it is
    coarse_base: Callable[[], SplatModel] | None = None  # with it, splats may be merged even where too few share a pixel: copies of the base itself

    def from_level(self, finer: FinerLevel, model: Callable[[], SplatModel]) -> StartProblem:
        """The same request, starting from such a model instead of from the base; `model` makes copies of it.

        The settings' `merge_to` stays a fraction of the base's splats. A finer level may be as good as it is: it is merged all the same.
        """
        counts = [len(splats.parameters()["means"]) for splats in (self.base(), finer.model)]
        config = self.config.model_copy(update={"merge_to": min(1.0, self.config.merge_to * counts[0] / counts[1])})
        views, closest_of = ([view.zoomed(finer.scale) for view in each] for each in (self.views, self.closest_of))
        return replace(
            self, base=model, views=views, closest_of=closest_of, scale=self.scale / finer.scale, base_effects=self.target, config=config,
            name=finer.name, may_lose=config.merging_costs, coarse_base=self.base,
        )  # fmt: skip
