"""Density control in the loop: what does nothing is dropped, and splats are added, on trial where that was asked for.

A clone doubles what its splat hides. On an object the steps until the next growth make good for most of that (lego at x2: from 38 dB to
37 after 50 steps, and 38 again after 100); in an unbounded scene, whose splats all hide each other, they do not (flowers at x2: from 43 dB
to 18, and 32 after 350 steps). So what views show is compared with the base when the next growth is due, and when the run ends. Where
they agree with it less than at the start of the run, the last growth is undone, and nothing is added any more.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization import density
from mipmap_plugin.adaptation.optimization.optimizer import put_back
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.views import extent
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.limits import mixed


@torch.no_grad()
def control_density(run: Run, task: Task, config: AdaptConfig) -> None:
    """Judge the last growth, grow, and prune."""
    judge(run, task, config)
    began_with = run.student.parameters()["means"]
    if run.gradients is not None:
        _grow(run, task, config, run.gradients.mean())
    density.prune(run.student, run.optimizer, run.student.row_opacities(task.views) >= config.min_opacity)
    means = run.student.parameters()["means"]
    run.gradients = None if run.gradients is None else density.ScreenGradients.of(means, config)
    run.rows_changed |= means is not began_with


@torch.no_grad()
def judge(run: Run, task: Task, config: AdaptConfig) -> None:
    """Undo the last growth if it is on trial and views have not got over it; then nothing grows any more."""
    trial = run.trial
    if trial is None or trial.before is None:
        return
    if task.agreement(run.student, config) >= trial.least_db:
        run.trial = replace(trial, before=None, passed=True)
        return
    put_back(run.student, run.optimizer, trial.before)
    run.trial = replace(trial, before=None, undone_at=run.step)
    run.gradients, run.rows_changed = None, True


def verdict(run: Run) -> str:
    """What to say of a run that grew on trial, after what ended it; nothing where all went well."""
    if run.trial is None or run.trial.undone_at is None:
        return ""
    return f"; growing was undone at step {run.trial.undone_at}, for it left views farther from the base than at the start"


def still(run: Run) -> tuple[str, ...]:
    """The parameters that do not move now. On trial, centers move to part what was cloned, and not where nothing is."""
    stays = run.trial is not None and run.trial.before is None and not run.trial.passed
    return ("means",) if stays else ()


def _grow(run: Run, task: Task, config: AdaptConfig, gradients: Tensor) -> None:
    assert config.densify_gradient is not None
    grown = density.strongest(gradients, config.densify_gradient, task.most_splats - len(gradients))
    if not grown.any():
        return
    if run.trial is not None:
        run.trial = replace(run.trial, before={name: tensor.detach().clone() for name, tensor in run.student.parameters().items()})
    shown = run.student.gaussians(task.views[0]).detach()
    if config.densify_keeps_image:
        density.halve(run.student, run.optimizer, grown, shown)
    else:
        generator = torch.Generator().manual_seed(mixed(config.seed, run.step))
        density.clone_and_split(run.student, run.optimizer, grown, extent(task.views), shown, generator)
