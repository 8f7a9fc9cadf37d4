"""Algorithm 1 of Mipmap-GS: optimize the splats against the images of the frozen base, resized to the new scale.

`adapt` repeats: choose views, make r(x̂) of those that have none yet, take a step, and check the splats on other views. A step draws x, compares it
with r(x̂), goes backward and moves the splats; every so many steps it prunes and densifies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from mipmap_plugin.adaptation.curve import INVISIBLE_ERROR, decibel
from mipmap_plugin.adaptation.optimization import density
from mipmap_plugin.adaptation.optimization.activation import Activation, WithGradients
from mipmap_plugin.adaptation.optimization.by_rows import ByRows
from mipmap_plugin.adaptation.optimization.checks import check, check_again, is_checked
from mipmap_plugin.adaptation.optimization.ending import End
from mipmap_plugin.adaptation.optimization.estimate import StepsBar
from mipmap_plugin.adaptation.optimization.growing import control_density, frozen_parameters, undo_harmful_growth
from mipmap_plugin.adaptation.optimization.interrupt import interruptible
from mipmap_plugin.adaptation.optimization.losses import compare
from mipmap_plugin.adaptation.optimization.optimizer import set_rates
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.optimization.validation import TIE_DB
from mipmap_plugin.adaptation.parallel import large_for_torch, max_threads, together, views_at_once
from mipmap_plugin.adaptation.views.schedule import ViewSchedule
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.process.threads import side_by_side
from mipmap_plugin.progress import ticking

# Truths that each of several threads makes at a time: the more, the less the threads wait for one another.
TRUTHS_AT_ONCE = 4

# Steps that are searched for each truth that is made ahead: as long as views are new, most steps have one.
STEPS_AHEAD = 2


def adapt(run: Run, task: Task, config: AdaptConfig, on_interrupt: Callable[[Run], None], observe: Callable[[Run], object] = lambda run: None) -> End:
    """Optimize `run.student` in place until its steps, budget, target or patience end the run; return which of them did.

    `on_interrupt` is called between two steps, or after the last, when Ctrl-C was pressed, and should raise. `observe` is called before the first
    step and after each step; its time is not counted, and the run ends if it returns True.
    """
    order = ViewSchedule(task.views, config)
    bar = StepsBar.of(run, task, config, order)
    with bar, ticking(bar), interruptible() as interrupted:
        reason = End.OBSERVER if observe(run) else run.reason_to_stop(config) or _nothing_to_gain(run, task, config)
        while reason is None and run.step < config.steps:
            with run.watch:
                views = order(run.step, run.progress(config))
                _make_truths(run, task, config, order, views)
                with run.threads.step(len(views), run.costs):
                    _step(run, task, config, views)
                if is_checked(run.step, config):
                    check(run, task, config)
            bar.show(run, task, config)
            reason = End.OBSERVER if observe(run) else run.reason_to_stop(config) or _nothing_to_gain(run, task, config)
            reason = reason or _no_time_for_truths(run, config, order)
            if interrupted():
                on_interrupt(run)
        with run.watch:
            undone = undo_harmful_growth(run, task, config)
            if run.curve[-1].step < run.step:
                check(run, task, config)
            elif undone:
                check_again(run, task)
        if interrupted():
            on_interrupt(run)
    return reason or End.STEPS


# docs/how_it_works.md shows the code up to the next such line.
# --8<-- [start:step]


def _step(run: Run, task: Task, config: AdaptConfig, views: Sequence[Camera]) -> None:
    if run.step == config.reset_opacity_at and task.white_background:
        density.reset_opacities(run.optimizer)
    task.follow(run.student)
    rate_factor = run.steering.rate_factor(run.step, config)
    set_rates(run.optimizer, config, run.step, run.progress(config), rate_factor, frozen_parameters(run))
    growing = run.gradients is not None  # by the gradients of each view
    at_once = 1 if growing else views_at_once(task.cameras[view] for view in views)
    run.by_rows = ByRows.of(run.student, task.render_to_step, run.by_rows) if len(views) <= at_once else None
    if run.by_rows is not None:
        _step_by_rows(run, run.by_rows, task, config, views)
    else:
        _step_by_autograd(run, task, config, views, at_once)
    run.step += 1
    if run.step % config.prune_every == 0 and run.step < config.steps:
        control_density(run, task, config)


def _step_by_rows(run: Run, rows: ByRows, task: Task, config: AdaptConfig, views: Sequence[Camera]) -> None:
    """A step by the backend, which sums the gradients of the views that are drawn and compared side by side."""

    def compared(numbers: Sequence[int], xs: Sequence[Tensor]) -> list[tuple[Tensor, Tensor]]:  # x: the student
        some = [views[number] for number in numbers]
        targets = [run.costs.truth(view, task.truth) for view in some]  # r(x̂): the frozen base, resized
        return compare(some, xs, targets, config, task.scale, task.detail)

    square_errors = rows.differentiate([task.cameras[view] for view in views], run.step * config.views_per_step, compared)
    run.square_error = run.square_error + torch.stack(square_errors).mean()
    if run.gradients is None:
        rows.step(run.optimizer, task.color_limits)
    else:
        means = run.student.parameters()["means"].detach().clone()  # as they were drawn
        gradient = torch.empty_like(means)
        rows.step(run.optimizer, task.color_limits, gradient)
        run.gradients.add(means, gradient, task.cameras[views[0]])


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
        compared = compare(some, images, targets, config, task.scale, task.detail)
        WithGradients.apply([gradient for gradient, _ in compared], *images).backward()  # type: ignore[no-untyped-call]  # torch's
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


def _nothing_to_gain(run: Run, task: Task, config: AdaptConfig) -> End | None:
    """Why there is no further step, where none would gain anything that can be seen."""
    if not task.dares and run.steering.is_stuck(run.progress(config), config):
        return End.STUCK
    alike = run.step == 0 and run.curve[0].validation_db > decibel(INVISIBLE_ERROR) - TIE_DB  # which is the most
    return End.ALIKE if alike and task.scale <= 1 and config.returns == "best" else None  # a zoom-in is compared with the base, not with its truth


def _no_time_for_truths(run: Run, config: AdaptConfig, order: ViewSchedule) -> End | None:
    """Why there is no next step, where the truths that it needs anew are expected to take longer than is left: large ones take seconds."""
    if config.time_budget_s is None or run.step >= config.steps:
        return None
    known = run.costs.truths
    takes = sum(view not in known for view in order(run.step, run.progress(config))) * sum(known.values()) / max(1, len(known))
    return End.TIME if takes > run.budget_left(config) else None
