"""Never less than given: views that nothing is adapted to tell how a run is going, and which of its states it returns.

Half of them steer: the run is compared with the base on them as it goes, steps that do harm are taken back, and the best state is kept.
The other half is asked once, at the end, and chooses among the base as it is, the start, the best state and the last.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
from torch import Tensor

from mipmap_plugin.adaptation.curve import decibel
from mipmap_plugin.adaptation.optimization.snapshot import Snapshot
from mipmap_plugin.adaptation.small import most_threads
from mipmap_plugin.adaptation.target.resize import difference_from
from mipmap_plugin.adaptation.views import choose_views
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.scenes.trajectories import jittered
from mipmap_plugin.threads import side_by_side

# Of the given cameras one in so many may be kept back for validation, where a policy leaves the choice of views to us.
KEPT_BACK = 16

# For so many views that steps draw there is one of validation, so that it takes a tenth of the time at most; but never fewer than `LEAST`.
STEPS_EACH = 25
LEAST = 4

# px: how much of a view is judged at most, along each side, so that judging large images stays cheap.
WINDOW = 768

# What sets the seed of views that are drawn for validation apart from that of views to adapt to.
OTHER_SEED = 7919

# dB: a state that is so much worse than the start is taken back. Rounding and the choice of views differ by less.
HARM = 0.1

# dB: a state has to be better by more than this to be kept instead of a later one, which more was learnt for.
HARDLY = 0.01

# A run whose steps did harm goes on with steps of this share.
GENTLER = 0.5

# The share of its rates that a run with a warm-up begins with.
FIRST = 1 / 32


@dataclass(frozen=True)
class Validation:
    """Views of the base scale with the truth of each, and how a model is compared with it."""

    steering: Sequence[Camera]
    choosing: Sequence[Camera]
    scale: float
    truth: Callable[[Camera], Tensor]  # a view of the base scale -> what it should show
    render: Callable[[Gaussians, Camera], Tensor]  # what a camera of the new scale sees
    resize: str  # the filter that brings an image to the truth's size
    others: Sequence[Callable[[Gaussians, Camera], Tensor]] = ()  # `render` of further viewers that the same splats have to be right in

    def in_each(self, model: SplatModel, views: Sequence[Camera]) -> list[float]:
        """In each viewer the mean PSNR over views, of images as they are displayed; 0 without views."""
        return [self._decibels(render, model, views) for render in (self.render, *self.others)]

    @torch.no_grad()
    def _decibels(self, render: Callable[[Gaussians, Camera], Tensor], model: SplatModel, views: Sequence[Camera]) -> float:
        def of_view(view: Camera) -> float:
            camera = view.zoomed(self.scale)
            image = render(model.gaussians(camera), camera).clamp(0, 1)
            return decibel(float(difference_from(self.truth(view), image, self.resize).square().mean()))

        at_once = most_threads(model.parameters()["means"], views[0].zoomed(self.scale)) if views else 1
        return sum(side_by_side(of_view, views, at_once)) / max(1, len(views))

    def steer(self, model: SplatModel) -> float:
        """Of the mean square over viewers, in which the worst weighs most. The worst alone falls now and then while all come closer, and
        the mean of their dB rises while it falls."""
        return decibel(fmean(10 ** (-found / 10) for found in self.in_each(model, self.steering)))

    def choose(self, states: dict[str, SplatModel]) -> tuple[str, dict[str, float]]:
        """The name of the best state, of equals the last, and the dB of each in the viewer that shows it worst."""
        found = {name: min(self.in_each(model, self.choosing)) for name, model in states.items()}
        best = max(found.values())
        return [name for name, each in found.items() if each >= best - HARDLY][-1], found


def unjudged(truth: Callable[[Camera], Tensor], render: Callable[[Gaussians, Camera], Tensor]) -> Validation:
    """Validation without a view, for a training, of which every step counts."""
    return Validation([], [], 1.0, truth, render, "area")


def hold_back(
    cameras: Sequence[Camera], views: Sequence[Camera], means: Tensor, scale: float, config: AdaptConfig
) -> tuple[list[Camera], list[Camera]]:
    """The `views` that are adapted to, and those of validation: of the given cameras, where a policy chooses among enough of them, and
    others from the region that they span; without cameras those of another orbit. Of large images the middle is judged, and nothing
    where one pixel of the base is larger than that."""
    if scale > WINDOW:
        return list(views), []
    left, judged = _hold_back(cameras, views, means, config)
    most = round(WINDOW / max(1.0, scale))
    return left, [view.window(most, most) for view in judged]


def _hold_back(cameras: Sequence[Camera], views: Sequence[Camera], means: Tensor, config: AdaptConfig) -> tuple[list[Camera], list[Camera]]:
    count = min(config.validation_views, max(LEAST, config.steps * config.views_per_step // STEPS_EACH))
    generator = torch.Generator().manual_seed(config.seed + OTHER_SEED)
    if config.views == "orbit" or not cameras:
        others, _ = choose_views(cameras, means, config.model_copy(update={"views": "orbit", "extra_views": count, "seed": config.seed + OTHER_SEED}))
        return list(views), others
    given = [view for view in views if view in set(cameras)]
    back = evenly(given[KEPT_BACK // 2 :], min(count // 2, len(given) // KEPT_BACK)) if config.views in ("train", "jittered") else []
    left = [view for view in views if view not in set(back)]
    drawn = jittered(given or list(views), count - len(back), generator)
    return left, [view for pair in zip(drawn, back, strict=False) for view in pair] + drawn[len(back) :]


@dataclass
class Steering:
    """How a run goes on views that it is not adapted to: its best state, and how bold its steps may be."""

    start_db: float
    best_db: float
    best: Snapshot
    best_step: int = 0
    ceiling: float = 1.0  # of every rate, where larger ones have done harm

    @classmethod
    def begin(cls, student: SplatModel, validation: Validation) -> Steering:
        found = validation.steer(student)
        return cls(found, found, Snapshot.of(student))

    def boldness(self, progress: float, config: AdaptConfig) -> float:
        """What every rate is multiplied by: it rises to 1 during the warm-up, by the same factor in each step, or to the ceiling."""
        risen = FIRST ** (1 - progress / config.warm_up) if progress < config.warm_up else 1.0
        return min(risen, self.ceiling)

    def harms(self, found: float) -> bool:
        return found < self.start_db - HARM

    def take_back(self, boldness: float) -> None:
        self.ceiling = GENTLER * boldness

    def keep(self, found: float, step: int, student: SplatModel, rows_changed: bool = False) -> None:
        if found >= self.best_db - HARDLY:
            self.best_db, self.best_step, self.best = max(found, self.best_db), step, Snapshot.of(student, rows_changed)
