"""Algorithm 1 of Mipmap-GS: optimise the splats against what the frozen base shows, resized to the new scale."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from tqdm import tqdm

from mipmap_plugin.adaptation import density
from mipmap_plugin.adaptation.activation import Activation
from mipmap_plugin.adaptation.closed_form import pixel_size
from mipmap_plugin.adaptation.curve import CurvePoint, Stopwatch, decibel, progress, reason_to_stop
from mipmap_plugin.adaptation.growing import Trial, control_density, judge, still
from mipmap_plugin.adaptation.interrupt import interruptible
from mipmap_plugin.adaptation.optimizer import make_optimizer, set_rates
from mipmap_plugin.adaptation.resize import difference_from
from mipmap_plugin.adaptation.views import Order
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel


@dataclass(frozen=True)
class Task:
    """What is to be optimised against what."""

    views: Sequence[Camera]  # at the base scale
    scale: float
    truth: Callable[[Camera], Tensor]  # a view of the base scale -> [h, w, 3] at the new scale
    render: Callable[[Gaussians, Camera], Tensor]  # what a camera of the new scale sees, and it -> [h, w, 3]
    white_background: bool
    detail: Callable[[Camera, Tensor], Tensor] | None = None  # what a view's image adds to the loss besides
    most_splats: int = sys.maxsize  # where growing ends

    def pixel(self, means: Tensor) -> float:
        """World units: the size of a target pixel at the median of `means` [N, 3]."""
        return float(pixel_size(means.detach(), self.views).median()) / self.scale


@dataclass
class Run:
    """Where a run stands: all that is needed to go on with it."""

    student: SplatModel
    optimizer: torch.optim.Adam
    watch: Stopwatch
    gradients: density.ScreenGradients | None  # None: nothing is cloned or split (any more), so nobody asks for them
    trial: Trial | None = None  # None: whatever grows stays
    step: int = 0
    curve: list[CurvePoint] = field(default_factory=list)
    square_error: Tensor | float = 0.0  # summed over the views since the last point of the curve, where the images are: no step waits for it
    rows_changed: bool = False  # splats were added or removed

    @classmethod
    def start(cls, student: SplatModel, task: Task, config: AdaptConfig) -> Run:
        means = student.parameters()["means"]
        optimizer, watch = make_optimizer(student, config, task.pixel(means)), Stopwatch()
        with watch:
            trial = Trial.begin(student, task, config)
        return cls(student, optimizer, watch, density.ScreenGradients.of(means, config), trial)


def adapt(run: Run, task: Task, config: AdaptConfig, on_interrupt: Callable[[Run], None], observe: Callable[[Run], None] = lambda run: None) -> str:
    """Optimise `run.student` in place until its steps, its budget, its target or its patience end; return which of them did.

    `on_interrupt` is called between two steps when Ctrl-C was pressed, and should raise. `observe` is called before the first
    step and after each, while the clock stands.
    """
    order, cameras = Order(task.views, config), {view: view.zoomed(task.scale) for view in task.views}
    bar = tqdm(total=config.steps, initial=run.step, disable=None, desc=f"adapting x{task.scale:g}", unit="step")
    with bar, interruptible() as interrupted:
        observe(run)
        reason = None
        while run.step < config.steps and reason is None:
            with run.watch:
                _step(run, task, config, order(run.step, progress(run.step, run.watch.seconds, config)), cameras)
                if run.step % config.check_every == 0 or run.step == config.steps:
                    run.square_error = float(run.square_error)  # here a GPU is waited for, so that the clock counts its work
            bar.update()
            if run.step % config.check_every == 0:
                _mark(run, config)
                bar.set_postfix_str(f"{run.curve[-1].psnr_db:.2f} dB, {run.curve[-1].gaussians} splats")
            observe(run)
            if interrupted():
                on_interrupt(run)
            reason = reason_to_stop(run.curve, run.watch.seconds, config)
        with run.watch:
            judge(run, task, config)
    return reason or f"{config.steps} steps"


def _step(run: Run, task: Task, config: AdaptConfig, views: Sequence[Camera], cameras: Mapping[Camera, Camera]) -> None:
    if run.step == config.reset_opacity_at and task.white_background:
        density.reset_opacities(run.optimizer)
    set_rates(run.optimizer, config, progress(run.step, run.watch.seconds, config), run.step, still=still(run))
    splats = Activation(run.student, share=len(views) > 1)
    before: Tensor | float = 0.0  # the gradient of the means from the views before this one
    for view in views:
        camera = cameras[view]
        target = task.truth(view)  # r(x̂): the frozen base, resized
        image = task.render(splats(camera), camera)  # x: the student at the new scale
        difference = difference_from(target, image, config.resize)
        loss = difference.square().mean() if config.loss == "l2" else difference.abs().mean()
        (loss if task.detail is None else loss + task.detail(view, image)).backward()
        run.square_error = run.square_error + difference.detach().square().mean().double() / len(views)
        if run.gradients is not None and splats.means.grad is not None:
            run.gradients.add(splats.means, splats.means.grad - before, camera)
            before = splats.means.grad.clone()
    splats.backward()
    run.optimizer.step()
    run.optimizer.zero_grad()
    run.step += 1
    if run.step % config.prune_every == 0 and run.step < config.steps:
        control_density(run, task, config)


def _mark(run: Run, config: AdaptConfig) -> None:
    """A new point of the curve, from the losses of the steps since the last one."""
    mean = float(run.square_error) / config.check_every
    run.curve.append(CurvePoint(step=run.step, seconds=run.watch.seconds, psnr_db=decibel(mean), gaussians=len(run.student.parameters()["means"])))
    run.square_error = 0.0
