"""Density control in the loop: transparent splats are removed, and splats are added, on trial if the settings say so.

A clone doubles what its splat hides. On an object, the steps until the next growth recover from that; in an unbounded scene, where all
splats hide each other, they do not (flowers at x2: from 43 dB to 18, and 32 after 350 steps). So the rendered views are compared with the
base when the next growth is due, and when the run ends. If they agree with it less than at the start of the run, the last growth is undone,
and no more splats are added.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization import density
from mipmap_plugin.adaptation.optimization.optimizer import restore_parameters
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.views.policy import extent
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.limits import derived_seed
from mipmap_plugin.models.contract import row_opacities


@torch.no_grad()
def control_density(run: Run, task: Task, config: AdaptConfig) -> None:
    """Undo the last growth if it did harm, grow, and prune."""
    undo_harmful_growth(run, task, config)
    before = run.student.parameters()["means"]
    if run.gradients is not None:
        _grow(run, task, config, run.gradients.mean())
    density.prune(run.student, run.optimizer, row_opacities(run.student, task.views) >= config.min_opacity)
    means = run.student.parameters()["means"]
    run.gradients = None if run.gradients is None else density.ScreenGradients.of(means, config)
    run.rows_changed |= means is not before


@torch.no_grad()
def undo_harmful_growth(run: Run, task: Task, config: AdaptConfig) -> bool:
    """Undo the last growth if it is on trial and the views are worse than at the start of the run; then stop growing. Return whether it was."""
    trial = run.trial
    if trial is None or trial.before is None:
        return False
    if task.agreement(run.student, config) >= trial.least_db:
        run.trial = replace(trial, before=None, passed=True)
        return False
    restore_parameters(run.student, run.optimizer, trial.before)
    run.trial = replace(trial, before=None, undone_at=run.step)
    run.gradients, run.rows_changed = None, True
    return True


def growth_note(run: Run) -> str:
    """A note on a growth that was undone, to follow the reason why the run ended; "" if none was."""
    if run.trial is None or run.trial.undone_at is None:
        return ""
    return f"; growth was undone at step {run.trial.undone_at}: the views were farther from the base than at the start"


def frozen_parameters(run: Run) -> tuple[str, ...]:
    """The names of the parameters that do not move now. With growth on trial, means move only to separate clones, once there are any."""
    no_clones = run.trial is not None and run.trial.before is None and not run.trial.passed
    return ("means",) if no_clones else ()


def _grow(run: Run, task: Task, config: AdaptConfig, gradients: Tensor) -> None:
    assert config.densify_gradient is not None
    selected = density.strongest(gradients, config.densify_gradient, task.max_splats - len(gradients))
    if not selected.any():
        return
    if run.trial is not None:
        run.trial = replace(run.trial, before={name: tensor.detach().clone() for name, tensor in run.student.parameters().items()})
    splats = run.student.gaussians(task.views[0]).detach()
    if config.densify_keeps_image:
        density.halve(run.student, run.optimizer, selected, splats)
    else:
        generator = torch.Generator().manual_seed(derived_seed(config.seed, run.step))
        density.clone_and_split(run.student, run.optimizer, selected, extent(task.views), splats, generator)
