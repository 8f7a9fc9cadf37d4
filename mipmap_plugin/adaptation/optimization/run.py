"""A run of Algorithm 1 as data: its task, and its current state."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from mipmap_plugin.adaptation.curve import CurvePoint, Stopwatch, decibel
from mipmap_plugin.adaptation.optimization.adam import Adam
from mipmap_plugin.adaptation.optimization.by_rows import ByRows
from mipmap_plugin.adaptation.optimization.costs import Costs
from mipmap_plugin.adaptation.optimization.density import ScreenGradients
from mipmap_plugin.adaptation.optimization.ending import End
from mipmap_plugin.adaptation.optimization.following import Following
from mipmap_plugin.adaptation.optimization.losses import Detail
from mipmap_plugin.adaptation.optimization.optimizer import make_optimizer
from mipmap_plugin.adaptation.optimization.quickest import QuickestThreads
from mipmap_plugin.adaptation.optimization.steering import Steering
from mipmap_plugin.adaptation.optimization.validation import Validation
from mipmap_plugin.adaptation.renderers import SteppingRenderer, ViewsRenderer
from mipmap_plugin.adaptation.target.resize import difference_from
from mipmap_plugin.adaptation.views.pixel_size import target_pixel
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel, count_of

# Number of views on which a student is compared with the base to assess a growth.
AGREEMENT_VIEWS = 8


@dataclass(frozen=True)
class Task:
    """What is optimized: the views, their truth, and the renderers."""

    views: Sequence[Camera]  # at the base scale
    scale: float
    truth: Callable[[Camera], Tensor]  # a view of the base scale -> [h, w, 3] at the new scale
    renders: Sequence[Callable[[Gaussians, Camera], Tensor]]  # splats and a camera of the new scale -> [h, w, 3]; of each viewer they are adapted for
    white_background: bool
    validation: Validation
    detail: Detail | None = None  # of a zoom-in with an upsampler
    max_splats: int = sys.maxsize  # growing stops at this number
    render_views: ViewsRenderer | None = None  # the same in one call, if the backend can
    render_to_step: SteppingRenderer | None = None  # the same if the backend can move the splats itself
    follow: Following = field(default_factory=Following)  # called before each step
    color_limits: tuple[float, float] | None = None  # of the coefficients of SH degree 0, which a step leaves within them
    part: str = ""  # of a scene, such as a tile or a level by distance, whose views are of another scale
    dares: bool = True  # whether a run that is stuck (`Steering.is_stuck`) goes on at full rates; else it ends
    pixel: float | None = None  # world units: the means move by such; None: by the pixel of the new scale at the median splat

    @cached_property
    def cameras(self) -> Mapping[Camera, Camera]:
        return {view: view.zoomed(self.scale) for view in self.views}

    def images(self, gaussians: Gaussians, cameras: Sequence[Camera], draw: int) -> list[Tensor]:
        """The images [h, w, 3] of the `draw`-th view since the beginning and of those after it: the viewers take turns."""
        if self.render_views is not None:
            return self.render_views(gaussians, cameras, draw)
        return [self.renders[(draw + number) % len(self.renders)](gaussians, camera) for number, camera in enumerate(cameras)]

    def count(self, model: SplatModel) -> int:
        """The number of splats that the first view shows at the new scale."""
        return count_of(model, self.views[0], self.scale)

    @torch.no_grad()
    def agreement(self, student: SplatModel, config: AdaptConfig) -> float:
        """PSNR (dB) of the student against the truth over some of the views."""
        errors = []
        for view in evenly(self.views, AGREEMENT_VIEWS):
            camera = view.zoomed(self.scale)
            image = self.renders[0](student.gaussians(camera), camera)
            errors.append(difference_from(self.truth(view), image, config.resize).square().mean())
        return decibel(float(torch.stack(errors).mean()))


@dataclass(frozen=True)
class Trial:
    """Growth on trial: the PSNR that it must not fall below, and the parameters to return to."""

    least_db: float  # the agreement of the views with the truth when the run began
    before: dict[str, Tensor] | None = None  # the parameters before a growth that has not been assessed yet
    passed: bool = False  # a growth has been assessed and kept
    undone_at: int | None = None  # the step at which a growth was undone


@dataclass
class Run:
    """The current state of a run: everything needed to continue it."""

    student: SplatModel
    optimizer: Adam
    watch: Stopwatch
    gradients: ScreenGradients | None  # None: nothing is cloned or split (any more), so they are not needed
    steering: Steering
    trial: Trial | None = None  # None: growth is never undone
    step: int = 0
    curve: list[CurvePoint] = field(default_factory=list)
    square_error: Tensor | float = 0.0  # summed since the last point of the curve, on the device of the images, so that no step waits for it
    rows_changed: bool = False  # splats were added or removed
    costs: Costs = field(default_factory=Costs)
    ended_by: End | None = None  # None while it takes steps
    by_rows: ByRows | None = None  # the student, while the backend moves it
    threads: QuickestThreads = field(default_factory=QuickestThreads)
    reserved: float = 0.0  # seconds of a time budget for what comes after the steps, and for a step that does not fit
    planned: int = 0  # steps for the time budget; 0: not planned (yet)

    @classmethod
    def start(cls, student: SplatModel, task: Task, config: AdaptConfig, spent: float = 0.0) -> Run:
        """A run before its first step; `spent`: the seconds used so far."""
        means = student.parameters()["means"]
        pixel = target_pixel(student, task.views, task.scale) if task.pixel is None else task.pixel
        optimizer, watch = make_optimizer(student, config, pixel), Stopwatch(seconds=spent)
        with watch:
            trial = Trial(task.agreement(student, config)) if config.densify_on_trial and config.densify_gradient is not None else None
            costs = Costs(motion=lambda: task.follow.seconds, device=means.device)
            quality = costs.check(lambda: task.validation.quality(student))
            steering = Steering.begin(student, quality.visible)
        first = CurvePoint(step=0, seconds=watch.read(), psnr_db=None, validation_db=quality.psnr, gaussians=task.count(student))
        return cls(student, optimizer, watch, ScreenGradients.of(means, config), steering, trial, curve=[first], costs=costs)

    def progress(self, config: AdaptConfig) -> float:
        """Fraction (0..1) of the steps that is over, or of what the start left of the time budget, whichever is larger."""
        before = self.curve[0].seconds + self.reserved
        left = math.inf if config.time_budget_s is None else max(config.time_budget_s - before, 1e-9)
        return min(1.0, max(self.step / max(1, config.steps), (self.seconds - before) / left))

    @property
    def seconds(self) -> float:
        """What is gone of a time budget."""
        return self.watch.seconds + self.reserved

    def budget_left(self, config: AdaptConfig) -> float:
        """Seconds of a time budget that are left; infinity without one."""
        return math.inf if config.time_budget_s is None else max(0.0, config.time_budget_s - self.seconds)

    def reason_to_stop(self, config: AdaptConfig) -> End | None:
        """Why it ends before its last step: the budget is spent, the target reached, or the knee passed; None to continue."""
        if not self.budget_left(config):
            if self.step:
                return End.TIME
            return End.START if self.watch.seconds >= (config.time_budget_s or 0.0) else End.CHOICE
        psnrs = [point.psnr_db for point in self.curve if point.psnr_db is not None]
        if config.target_db is not None and psnrs and psnrs[-1] >= config.target_db:
            return End.TARGET
        patience = config.patience
        if patience is not None and len(psnrs) > patience and max(psnrs[-patience:]) < max(psnrs[:-patience]) + config.min_gain_db:
            return End.KNEE
        return None

    def states(self, initial: SplatModel) -> dict[str, SplatModel]:
        """The best and the last state, where they differ from the start (the `initial` model) and from each other, by what reports call them."""
        best, states = self.steering.best_step, {}
        if 0 < best < self.step:
            states[f"the state after step {best}"] = self.steering.best.over(initial)
        if self.step and not self.curve[-1].taken_back:  # otherwise it is the start, or the best one
            states["the last state"] = self.student
        return states
