"""Algorithm 1 of Mipmap-GS: optimize the splats against the images of the frozen base, resized to the new scale."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from mipmap_plugin.adaptation.curve import CurvePoint, decibel
from mipmap_plugin.adaptation.optimization import density
from mipmap_plugin.adaptation.optimization.activation import Activation
from mipmap_plugin.adaptation.optimization.by_rows import ByRows
from mipmap_plugin.adaptation.optimization.ending import End
from mipmap_plugin.adaptation.optimization.estimate import BAR, Bar, Forecast
from mipmap_plugin.adaptation.optimization.evaluations import Evaluations
from mipmap_plugin.adaptation.optimization.growing import control_density, frozen_parameters, undo_harmful_growth
from mipmap_plugin.adaptation.optimization.interrupt import interruptible
from mipmap_plugin.adaptation.optimization.losses import gradient_of
from mipmap_plugin.adaptation.optimization.optimizer import restore_snapshot, set_rates
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.parallel import large_for_torch, max_threads, together, views_at_once
from mipmap_plugin.adaptation.target.resize import difference_from, gradient_before
from mipmap_plugin.adaptation.views import ViewSchedule
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.process.threads import side_by_side
from mipmap_plugin.progress import hidden, ticking

# Number of checks during the warm-up, while the rates rise.
CHECKS_IN_WARM_UP = 10

# Number of checks of a short run, at least STEPS_BETWEEN steps apart, because a check takes as long as a step.
CHECKS, STEPS_BETWEEN = 6, 5

# Truths that each of several threads makes at a time: the more, the less the threads wait for one another.
TRUTHS_AT_ONCE = 4

# A display shows white, 1, at most: what is brighter, as a sky may be by far, would outweigh all else. At zoom-out so much of it counts, as otherwise
# steps leave colors too bright for views that they did not see: lego and chair lose 1.7 and 2.6 dB at x1/4. At zoom-in nothing does. Beside an edge
# a truth is brighter than white too, for a bicubic filter overshoots: there so much beyond the truth counts.
BEYOND_WHITE = 0.02

# Steps that are searched for each truth that is made ahead: as long as views are new, most steps have one.
STEPS_AHEAD = 2


def adapt(run: Run, task: Task, config: AdaptConfig, on_interrupt: Callable[[Run], None], observe: Callable[[Run], object] = lambda run: None) -> End:
    """Optimize `run.student` in place until its steps, budget, target or patience end the run; return which of them did.

    `on_interrupt` is called between two steps, or after the last, when Ctrl-C was pressed, and should raise. `observe` is called before the first
    step and after each step; its time is not counted, and the run ends if it returns True.
    """
    order = ViewSchedule(task.views, config)
    run.costs.motion = lambda: task.follow.seconds
    forecast = Forecast(order, config, partial(checks_until, config), Evaluations(task.follow, config, len(task.validation.steering)), run.step)
    began = run.watch.seconds - run.costs.seconds()
    bar = Bar(total=config.steps, initial=run.step, disable=hidden(), desc=f"adapting {task.part or f'x{task.scale:g}'}", unit="step", bar_format=BAR)
    with bar, ticking(bar), interruptible() as interrupted:
        reason = End.OBSERVER if observe(run) else run.reason_to_stop(config)
        while reason is None and run.step < config.steps:
            with run.watch:
                views = order(run.step, run.progress(config))
                _make_truths(run, task, config, order, views)
                with run.threads.step(len(views), run.costs):
                    _step(run, task, config, views)
                if is_checked(run.step, config):
                    _check(run, task, config)
            left = forecast.left(run.step, run.watch.seconds - began, run.costs, run.steering.ceiling)
            bar.seconds_left = min(left, _budget_left(run, config))
            bar.update()
            if run.curve[-1].step == run.step:
                quality = f"{run.curve[-1].validation_db:.2f} dB, " if task.validation.steering else ""
                bar.set_postfix_str(f"{quality}{run.curve[-1].gaussians} splats")
            reason = End.OBSERVER if observe(run) else run.reason_to_stop(config) or _no_time_for_truths(run, config, order)
            if interrupted():
                on_interrupt(run)
        with run.watch:
            undone = undo_harmful_growth(run, task, config)
            if run.curve[-1].step < run.step:
                _check(run, task, config)
            elif undone:  # the check of this step was of the growth
                psnr = run.costs.check(lambda: task.validation.quality(run.student)).psnr
                run.curve[-1] = run.curve[-1].model_copy(update={"validation_db": psnr, "gaussians": task.count(run.student)})
        if interrupted():
            on_interrupt(run)
    return reason or End.STEPS


def _budget_left(run: Run, config: AdaptConfig) -> float:
    return math.inf if config.time_budget_s is None else max(0.0, config.time_budget_s - run.seconds)


def _no_time_for_truths(run: Run, config: AdaptConfig, order: ViewSchedule) -> End | None:
    """Why there is no next step, where the truths that it needs anew are expected to take longer than is left: large ones take seconds."""
    known, views = run.costs.truths, order(run.step, run.progress(config)) if run.step < config.steps else []
    takes = sum(view not in known for view in views) * sum(known.values()) / max(1, len(known))
    return End.TIME if takes > _budget_left(run, config) else None


def is_checked(step: int, config: AdaptConfig) -> bool:
    """Whether the run is checked after this step: more often during the warm-up, and if the run is short."""
    return step % _steps_between(config, warming_up=step < config.warm_up_steps) == 0 or step in (config.warm_up_steps, config.steps)


def checks_until(config: AdaptConfig, step: int) -> int:
    """The number of checks up to and after this step, by arithmetic: a run that a budget ends may be given millions of steps."""
    warm_up, last = config.warm_up_steps, config.steps
    early, late = (_steps_between(config, warming_up=warming_up) for warming_up in (True, False))
    before = max(0, warm_up - 1)  # the last step of the warm-up that is checked as such
    count = min(step, before) // early
    if step >= warm_up:
        count += step // late - before // late + (warm_up % late > 0)
    return count + (step >= last != warm_up and last % late > 0)


def _steps_between(config: AdaptConfig, *, warming_up: bool) -> int:
    """The number of steps between two checks."""
    every = math.ceil(config.warm_up_steps / CHECKS_IN_WARM_UP) if warming_up else max(STEPS_BETWEEN, config.steps // CHECKS)
    return max(1, min(every, config.check_every))


# docs/how_it_works.md shows the code up to the next such line.
# --8<-- [start:step]


def _step(run: Run, task: Task, config: AdaptConfig, views: Sequence[Camera]) -> None:
    if run.step == config.reset_opacity_at and task.white_background:
        density.reset_opacities(run.optimizer)
    task.follow(run.student)
    progress = run.progress(config)
    set_rates(run.optimizer, config, progress, run.steering.rate_factor(run.step, config), frozen=frozen_parameters(run))
    growing = run.gradients is not None  # by the gradients of each view, which no step by rows has
    at_once = 1 if growing else views_at_once(task.cameras[view] for view in views)
    run.by_rows = None if growing or len(views) > at_once else ByRows.of(run.student, task.render_to_step, run.by_rows)
    if run.by_rows is not None:
        _step_by_rows(run, run.by_rows, task, config, views)
    else:
        _step_by_autograd(run, task, config, views, at_once)
    run.step += 1
    if run.step % config.prune_every == 0 and run.step < config.steps:
        control_density(run, task, config)


def _step_by_rows(run: Run, rows: ByRows, task: Task, config: AdaptConfig, views: Sequence[Camera]) -> None:
    """A step by the backend, which sums the gradients of the views that are drawn and compared side by side."""

    def compare(numbers: Sequence[int], xs: Sequence[Tensor]) -> list[tuple[Tensor, Tensor]]:  # x: the student
        some = [views[number] for number in numbers]
        targets = [run.costs.truth(view, task.truth) for view in some]  # r(x̂): the frozen base, resized
        return _compare_all(task, config, some, xs, targets)

    square_errors = rows.differentiate([task.cameras[view] for view in views], run.step * config.views_per_step, compare)
    run.square_error = run.square_error + torch.stack(square_errors).mean()
    rows.step(run.optimizer, task.color_limits)


# --8<-- [end:step]


def _step_by_autograd(run: Run, task: Task, config: AdaptConfig, views: Sequence[Camera], at_once: int) -> None:
    """A step from the gradients of all splats, which are summed over calls of `at_once` views each if the backend draws several in a call."""
    splats, cameras = Activation(run.student, share=len(views) > 1), task.cameras
    with large_for_torch(run.student.parameters()["means"]):
        splats.activate(cameras[views[0]])
    at_once = at_once if splats.shares and task.render_views else 1
    for number in range(0, len(views), at_once):
        some = views[number : number + at_once]
        targets = [run.costs.truth(view, task.truth) for view in some]
        gaussians = splats(cameras[some[0]])
        images = task.images(gaussians, [cameras[view] for view in some], run.step * config.views_per_step + number)
        compared = _compare_all(task, config, some, images, targets)
        torch.autograd.backward(images, [gradient for gradient, _ in compared])
        run.square_error = run.square_error + sum(square_error for _, square_error in compared) / len(views)
        if run.gradients is not None:
            run.gradients.add(*splats.means_gradient(gaussians), cameras[some[0]])
        splats.accumulate(gaussians)
        del gaussians, images  # what the gradients need has the memory of these
    with large_for_torch(run.student.parameters()["means"]):
        splats.backward()
        run.optimizer.step()
    run.optimizer.zero_grad()
    if task.color_limits is not None and (colors := run.student.parameters().get("sh0")) is not None:
        colors.detach().clamp_(*task.color_limits)


def _compare_all(
    task: Task, config: AdaptConfig, views: Sequence[Camera], images: Sequence[Tensor], targets: Sequence[Tensor]
) -> list[tuple[Tensor, Tensor]]:
    """`_compare` of several views: in one operation where their images are of one size, since a GPU waits for each."""
    if task.scale > 1 and config.compare_at == "base":
        images = [image.detach().clamp_max(1) for image in images]
    elif task.scale <= 1 and config.loss == "psnr":
        images = [image.detach().minimum(target.clamp_min(1) + BEYOND_WHITE) for image, target in zip(images, targets, strict=True)]
    if len(images) == 1 or task.detail is not None or len({image.shape for image in (*images, *targets)}) > 1:
        return [_compare(task, config, *each) for each in zip(views, images, targets, strict=True)]
    gradients, square_errors = gradient_of(torch.stack(list(images)).detach() - torch.stack(list(targets)), config.loss)
    return list(zip(gradients.unbind(), square_errors.unbind(), strict=True))


def _compare(task: Task, config: AdaptConfig, view: Camera, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """The gradient of the loss of an image, [h, w, 3], and its mean square error, []."""
    image = image.detach()
    if task.detail is None:
        gradient, square_error = gradient_of(difference_from(target, image, config.resize), config.loss)
        return gradient_before(gradient, (image.shape[0], image.shape[1]), config.resize), square_error
    difference = difference_from(target, image.requires_grad_(), config.resize)
    gradient, square_error = gradient_of(difference.detach(), config.loss)
    further = task.detail(view, image)
    [whole] = torch.autograd.grad((difference, further), image, (gradient, torch.ones_like(further)))
    return whole, square_error


def _make_truths(run: Run, task: Task, config: AdaptConfig, order: ViewSchedule, views: Sequence[Camera]) -> None:
    """Make the truths of a step's views that have none yet, and of some views that are used next: in one call, or several in each thread."""
    known, new = run.costs.truths, [view for view in views if view not in run.costs.truths]
    if not new:
        return
    means, prepare = run.student.parameters()["means"], getattr(task.truth, "prepare", None)
    at_once, in_a_call = max_threads(means, new[0].zoomed(task.scale)), 1 if prepare is None else together(means, task.views)
    wanted = max(in_a_call, TRUTHS_AT_ONCE * at_once if at_once > 1 else 1)
    for step in range(run.step + 1, min(run.step + 1 + STEPS_AHEAD * wanted, config.steps)):
        if len(new) >= wanted:
            break
        new += [view for view in order(step, run.progress(config)) if view not in known and view not in new]
    if prepare is not None and in_a_call > 1:
        run.costs.prepare(new, prepare)
    else:
        list(side_by_side(lambda view: run.costs.truth(view, task.truth), new, at_once))


def _check(run: Run, task: Task, config: AdaptConfig) -> None:
    """Measure the run on validation views: keep its state or undo the last steps, and append a point to the curve."""
    steering, steps = run.steering, run.step - run.curve[-1].step
    quality = run.costs.check(lambda: task.validation.quality(run.student))
    growing = run.trial is not None and run.trial.before is not None  # a growth gets some steps before it is assessed
    factor, rising = steering.rate_factor(run.step, config), steering.is_rising(run.step, config)
    harmful = config.returns == "best" and not growing and steering.is_harmful(quality.visible, rising=rising)
    if harmful:
        steering.reduce_rates(factor, rising=rising)
        run.rows_changed |= len(steering.best.rows["means"]) != len(run.student.parameters()["means"])
        restore_snapshot(run.student, run.optimizer, steering.best)
        run.gradients = None if run.gradients is None else density.ScreenGradients.of(run.student.parameters()["means"], config)
    else:
        steering.update_best(quality.visible, run.step, run.student, run.rows_changed, factor)
    steering.dare(run.progress(config), config)
    mean = float(run.square_error) / max(1, steps)  # this waits for a GPU, so that the clock counts its work
    best_db = next((point.validation_db for point in reversed(run.curve) if point.step == steering.best_step), quality.psnr)
    point = CurvePoint(
        step=run.step, seconds=run.watch.read(), psnr_db=decibel(mean) if steps else None,
        validation_db=best_db if harmful else quality.psnr, gaussians=task.count(run.student), taken_back=harmful,
    )  # fmt: skip
    run.curve.append(point)
    run.square_error = 0.0
