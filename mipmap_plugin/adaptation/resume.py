"""An interrupted run on disk: written atomically, read without executing anything, refused when it belongs to another run."""

from __future__ import annotations

import time
import warnings
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

import torch

from mipmap_plugin.adaptation.curve import CurvePoint, Stopwatch
from mipmap_plugin.adaptation.density import ScreenGradients
from mipmap_plugin.adaptation.growing import Trial
from mipmap_plugin.adaptation.loop import Run, Task
from mipmap_plugin.adaptation.optimizer import make_optimizer
from mipmap_plugin.adaptation.snapshot import Snapshot
from mipmap_plugin.adaptation.validation import Steering
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import OutputError, SettingsError
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.models.torch_file import save_torch

# Seconds between two states of a long run: what a killed process loses at most. A state is about three times as large as the model,
# four times where that grows on trial.
KEEP_EVERY_S = 60.0


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during adaptation; the text says where the run can be resumed from."""


class Keeper:
    """Keeps the state of one run in a file, if there is one to keep it in: every minute, and when the run is interrupted."""

    def __init__(self, path: Path | None, fingerprint: str) -> None:
        self._path, self._fingerprint = path, fingerprint
        self._kept = time.monotonic()

    def begin(self, student: SplatModel, task: Task, config: AdaptConfig, spent: float) -> Run:
        """A new run, `spent` seconds after it was asked for, or the one in the file. Raises SettingsError (`load_run`)."""
        if self._path is None or not self._path.exists():
            return Run.start(student, task, config, spent)
        return load_run(self._path, student, task, config, self._fingerprint)

    def now_and_then(self, run: Run) -> None:
        """Write the state if the last one is old. A disk that has no room for it does not end the run."""
        if self._path is None or time.monotonic() - self._kept < KEEP_EVERY_S:
            return
        try:
            save_run(run, self._path, self._fingerprint)
        except OutputError as error:
            warnings.warn(f"the run goes on, but could not be resumed if it were killed: {error}", stacklevel=2)
        self._kept = time.monotonic()

    def stop(self, run: Run) -> NoReturn:
        """Write the state and raise Interrupted. Raises OutputError when the disk refuses."""
        if self._path is None:
            raise Interrupted(f"interrupted at step {run.step}; nothing was written, for no file to resume from was named")
        save_run(run, self._path, self._fingerprint)
        raise Interrupted(f"interrupted at step {run.step}; run the same command again to go on from {self._path}")


def save_run(run: Run, path: Path, fingerprint: str) -> None:
    """Write all that `load_run` needs. `fingerprint` names the base, the settings and the views."""
    state = {
        "fingerprint": fingerprint,
        "step": run.step,
        "seconds": run.watch.seconds,
        "square_error": float(run.square_error),
        "rows_changed": run.rows_changed,
        "curve": [point.model_dump() for point in run.curve],
        "parameters": {name: tensor.detach() for name, tensor in run.student.parameters().items()},
        "shared": {name: tensor.detach() for name, tensor in run.student.shared_parameters().items()},
        "optimizer": run.optimizer.state_dict(),
        "gradients": None if run.gradients is None else (run.gradients.total, run.gradients.seen),
        "steering": {field.name: getattr(run.steering, field.name) for field in fields(run.steering)} | {"best": vars(run.steering.best)},
        "trial": None if run.trial is None else {field.name: getattr(run.trial, field.name) for field in fields(run.trial)},
    }
    save_torch(path, state, overwrite=True)


def load_run(path: Path, student: SplatModel, task: Task, config: AdaptConfig, fingerprint: str) -> Run:
    """The run that `save_run` wrote, over `student`'s own parameters. Raises SettingsError when it is of another run or unreadable."""
    state = _read(path)
    if not isinstance(state, dict) or state.get("fingerprint") != fingerprint:
        raise SettingsError(f"{path}: it belongs to another base, other settings or other views; repeat those, or delete the file to start anew")
    device = student.parameters()["means"].device
    # On a GPU light is summed in any order, so that merging anew may leave a splat more or less than it did.
    if state["rows_changed"] or state["parameters"]["means"].shape != student.parameters()["means"].shape:
        student.replace_parameters({name: tensor.to(device).requires_grad_() for name, tensor in state["parameters"].items()})
    else:  # the rows are those that the run began with, and so is whatever the model carries along by row
        with torch.no_grad():
            for name, tensor in student.parameters().items():
                tensor.copy_(state["parameters"][name])
    with torch.no_grad():
        for name, tensor in student.shared_parameters().items():
            tensor.copy_(state["shared"][name])
    optimizer = make_optimizer(student, config, pixel=1.0)  # the state knows the rates
    optimizer.load_state_dict(state["optimizer"])
    gradients = ScreenGradients.of(student.parameters()["means"], config) if state["gradients"] else None
    if gradients is not None:
        gradients.total, gradients.seen = (tensor.to(device) for tensor in state["gradients"])
    steering = Steering(**{**state["steering"], "best": Snapshot(**state["steering"]["best"]).to(device)})
    return Run(
        student, optimizer, Stopwatch(seconds=state["seconds"]), gradients, steering, _trial(state["trial"], device), state["step"],
        [CurvePoint(**point) for point in state["curve"]], state["square_error"], state["rows_changed"],
    )  # fmt: skip


def _trial(state: dict[str, Any] | None, device: torch.device) -> Trial | None:
    if state is None:
        return None
    before = state["before"] and {name: tensor.to(device) for name, tensor in state["before"].items()}
    return Trial(**{**state, "before": before})


def _read(path: Path) -> Any:
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load fails in many ways on a file that is not its own
        raise SettingsError(f"{path}: this is not the state of an interrupted run ({type(error).__name__}); delete it to start anew") from error
