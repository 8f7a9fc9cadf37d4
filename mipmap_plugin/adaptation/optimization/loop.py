"""Algorithm 1 of Mipmap-GS: optimize the splats against what the frozen base shows, resized to the new scale."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from torch import Tensor
from tqdm import tqdm

from mipmap_plugin.adaptation.curve import CurvePoint, decibel, reason_to_stop
from mipmap_plugin.adaptation.optimization import density
from mipmap_plugin.adaptation.optimization.activation import Activation
from mipmap_plugin.adaptation.optimization.growing import control_density, judge, still
from mipmap_plugin.adaptation.optimization.interrupt import interruptible
from mipmap_plugin.adaptation.optimization.optimizer import set_rates, take_back
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.small import most_threads
from mipmap_plugin.adaptation.target.resize import difference_from
from mipmap_plugin.adaptation.views import Order
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.threads import side_by_side

# Of a mean square difference: half a step of an 8-bit image, squared. What is closer than a display can show counts no more.
UNSEEN = (0.5 / 255) ** 2

# While rates rise, a run is looked at so many times.
CHECKS_RISING = 10


def adapt(run: Run, task: Task, config: AdaptConfig, on_interrupt: Callable[[Run], None], observe: Callable[[Run], None] = lambda run: None) -> str:
    """Optimize `run.student` in place until its steps, its budget, its target or its patience end; return which of them did.

    `on_interrupt` is called between two steps when Ctrl-C was pressed, and should raise. `observe` is called before the first
    step and after each, while the clock stands.
    """
    order, cameras = Order(task.views, config), {view: view.zoomed(task.scale) for view in task.views}
    bar = tqdm(total=config.steps, initial=run.step, disable=None, desc=f"adapting x{task.scale:g}", unit="step")
    with bar, interruptible() as interrupted:
        observe(run)
        while (reason := reason_to_stop(run.curve, run.watch.seconds, config)) is None and run.step < config.steps:
            with run.watch:
                _step(run, task, config, order(run.step, run.progress(config)), cameras)
                if is_checked(run.step, config):
                    _check(run, task, config)
            bar.update()
            if run.curve[-1].step == run.step:
                bar.set_postfix_str(f"{run.curve[-1].validation_db:.2f} dB, {run.curve[-1].gaussians} splats")
            observe(run)
            if interrupted():
                on_interrupt(run)
        with run.watch:
            judge(run, task, config)
            if run.curve[-1].step < run.step:
                _check(run, task, config)
    return reason or f"{config.steps} steps"


def is_checked(step: int, config: AdaptConfig) -> bool:
    """Whether the run is looked at after this step: more often while the rates rise."""
    rising = config.warm_up_steps
    return step % (config.check_every if step >= rising else max(1, min(config.check_every, rising // CHECKS_RISING))) == 0 or step == config.steps


# Shown in docs/how_it_works.md, up to the next such line.
# --8<-- [start:step]


def _step(run: Run, task: Task, config: AdaptConfig, views: Sequence[Camera], cameras: Mapping[Camera, Camera]) -> None:
    if run.step == config.reset_opacity_at and task.white_background:
        density.reset_opacities(run.optimizer)
    now = run.progress(config)
    set_rates(run.optimizer, config, now, run.steering.boldness(now, config), still=still(run))
    splats = Activation(run.student, share=len(views) > 1)
    splats.activate(cameras[views[0]])

    def compare(place: tuple[int, Camera]) -> tuple[Gaussians, Camera, Tensor]:
        nth, view = place
        seen, camera = splats(cameras[view]), cameras[view]
        target = task.truth(view)  # r(x̂): the frozen base, resized
        image = task.drawn(nth)(seen, camera)  # x: the student at the new scale
        difference = difference_from(target, image, config.resize)
        loss = _loss(difference, config.loss)
        (loss if task.detail is None else loss + task.detail(view, image)).backward()
        return seen, camera, difference.detach().square().mean()

    places = list(enumerate(views, run.step * config.views_per_step))
    at_once = most_threads(run.student.parameters()["means"], cameras[views[0]]) if splats.shares else 1
    for seen, camera, square in side_by_side(compare, places, at_once):
        run.square_error = run.square_error + square.double() / len(views)
        splats.gather(seen)
        if run.gradients is not None:
            run.gradients.add(*splats.of_means(seen), camera)
    splats.backward()
    run.optimizer.step()
    run.optimizer.zero_grad()
    run.step += 1
    if run.step % config.prune_every == 0 and run.step < config.steps:
        control_density(run, task, config)


# --8<-- [end:step]


def _loss(difference: Tensor, name: str) -> Tensor:
    """Of one image. `psnr` is in nepers what PSNR is in decibels, so that no view that is far off outweighs the others."""
    if name == "l1":
        return difference.abs().mean()
    square = difference.square().mean()
    return (square + UNSEEN).log() if name == "psnr" else square


def _check(run: Run, task: Task, config: AdaptConfig) -> None:
    """Look at the run on validation views: keep its state or take it back, and note a point of the curve."""
    steering, steps = run.steering, run.step - run.curve[-1].step
    found = task.validation.steer(run.student)
    growing = run.trial is not None and run.trial.before is not None  # what grew is judged when it had time
    harmed = config.returns == "best" and not growing and steering.harms(found)
    if harmed:
        steering.take_back(steering.boldness(run.progress(config), config))
        run.rows_changed |= len(steering.best.rows["means"]) != len(run.student.parameters()["means"])
        take_back(run.student, run.optimizer, steering.best)
        run.gradients = None if run.gradients is None else density.ScreenGradients.of(run.student.parameters()["means"], config)
    else:
        steering.keep(found, run.step, run.student, run.rows_changed)
    mean = float(run.square_error) / max(1, steps)  # here a GPU is waited for, so that the clock counts its work
    facts = dict(psnr_db=decibel(mean) if steps else None, validation_db=steering.best_db if harmed else found, taken_back=harmed)
    run.curve.append(CurvePoint(step=run.step, seconds=run.watch.read(), gaussians=len(run.student.parameters()["means"]), **facts))
    run.square_error = 0.0
