"""A run of Algorithm 1 as data: what is to be optimized against what, and where it stands."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mipmap_plugin.adaptation.curve import CurvePoint, Stopwatch, decibel, progress
from mipmap_plugin.adaptation.optimization.adam import Adam
from mipmap_plugin.adaptation.optimization.density import ScreenGradients
from mipmap_plugin.adaptation.optimization.optimizer import make_optimizer
from mipmap_plugin.adaptation.optimization.validation import Steering, Validation
from mipmap_plugin.adaptation.start.closed_form import pixel_size
from mipmap_plugin.adaptation.target.resize import difference_from
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel

# Views that are asked how far they agree with the base.
JUDGES = 8


@dataclass(frozen=True)
class Task:
    """What is to be optimized against what."""

    views: Sequence[Camera]  # at the base scale
    scale: float
    truth: Callable[[Camera], Tensor]  # a view of the base scale -> [h, w, 3] at the new scale
    render: Callable[[Gaussians, Camera], Tensor]  # what a camera of the new scale sees, and it -> [h, w, 3]
    white_background: bool
    validation: Validation
    detail: Callable[[Camera, Tensor], Tensor] | None = None  # what a view's image adds to the loss besides
    most_splats: int = sys.maxsize  # where growing ends
    others: Sequence[Callable[[Gaussians, Camera], Tensor]] = ()  # `render` of further viewers that the same splats have to be right in

    def drawn(self, draw: int) -> Callable[[Gaussians, Camera], Tensor]:
        """What renders the `draw`-th view since the beginning: each viewer takes its turn."""
        return (self.render, *self.others)[draw % (1 + len(self.others))]

    def pixel(self, means: Tensor) -> float:
        """World units: the size of a target pixel at the median of `means` [N, 3]."""
        return float(pixel_size(means.detach(), self.views).median()) / self.scale

    @torch.no_grad()
    def agreement(self, student: SplatModel, config: AdaptConfig) -> float:
        """dB: how close some of the views are to the truth."""
        errors = []
        for view in evenly(self.views, JUDGES):
            camera = view.zoomed(self.scale)
            image = self.render(student.gaussians(camera), camera)
            errors.append(difference_from(self.truth(view), image, config.resize).square().mean())
        return decibel(float(torch.stack(errors).mean()))


@dataclass(frozen=True)
class Trial:
    """What growths are judged by, and what the last one is undone to."""

    least_db: float  # how close the views were to the truth when the run began
    before: dict[str, Tensor] | None = None  # the parameters before a growth that is not judged yet
    passed: bool = False  # a growth has been judged, and stays
    undone_at: int | None = None  # the step at which one was undone

    @classmethod
    def begin(cls, student: SplatModel, task: Task, config: AdaptConfig) -> Trial | None:
        """Of a run that begins with `student`; None where whatever grows stays."""
        if config.densify_on_trial and config.densify_gradient is not None:
            return cls(task.agreement(student, config))
        return None


@dataclass
class Run:
    """Where a run stands: all that is needed to go on with it."""

    student: SplatModel
    optimizer: Adam
    watch: Stopwatch
    gradients: ScreenGradients | None  # None: nothing is cloned or split (any more), so nobody asks for them
    steering: Steering
    trial: Trial | None = None  # None: whatever grows stays
    step: int = 0
    curve: list[CurvePoint] = field(default_factory=list)
    square_error: Tensor | float = 0.0  # summed over the steps since the last point of the curve, where the images are: no step waits for it
    rows_changed: bool = False  # splats were added or removed

    @classmethod
    def start(cls, student: SplatModel, task: Task, config: AdaptConfig, spent: float = 0.0) -> Run:
        """Before the first step; `spent`: the seconds that came before."""
        means = student.parameters()["means"]
        optimizer, watch = make_optimizer(student, config, task.pixel(means)), Stopwatch(seconds=spent)
        with watch:
            trial, steering = Trial.begin(student, task, config), Steering.begin(student, task.validation)
        first = CurvePoint(step=0, seconds=watch.read(), psnr_db=None, validation_db=steering.start_db, gaussians=len(means))
        return cls(student, optimizer, watch, ScreenGradients.of(means, config), steering, trial, curve=[first])

    def progress(self, config: AdaptConfig) -> float:
        return progress(self.step, self.watch.seconds, config)
