"""The state of a run on disk, to resume it: written atomically, read without executing code, refused if it belongs to another run."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, NoReturn

import torch

from mipmap_plugin.adaptation.curve import CurvePoint, Stopwatch
from mipmap_plugin.adaptation.optimization.costs import Costs
from mipmap_plugin.adaptation.optimization.density import ScreenGradients
from mipmap_plugin.adaptation.optimization.ending import End
from mipmap_plugin.adaptation.optimization.optimizer import make_optimizer
from mipmap_plugin.adaptation.optimization.run import Run, Task, Trial
from mipmap_plugin.adaptation.optimization.snapshot import Snapshot
from mipmap_plugin.adaptation.optimization.state_file import StateFile, claim_state_file
from mipmap_plugin.adaptation.optimization.steering import Steering
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import CheckpointError, OutputError, SettingsError, warn
from mipmap_plugin.formats.atomic import refuse_output
from mipmap_plugin.formats.torch_file import load_torch, save_torch
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.process.versions import versions

# Seconds between two saved states: the most that a killed process loses. A state is about three times as large as the model, four times
# with growth on trial.
SAVE_EVERY_S = 60.0

# Seconds that saving may take for that pace. A larger state is saved less often, so that a thirtieth of a run at most is spent on it.
QUICK_SAVE_S = 2.0


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during adaptation; the message names the file that the run can be resumed from."""


class StateKeeper:
    """Saves the state of one run to a file, if one was requested: every minute, large ones less often, and when the run is interrupted."""

    def __init__(self, path: Path | None, fingerprint: str) -> None:
        self._requested, self._fingerprint = path, fingerprint
        self.file: StateFile | None = None  # where this run saves its state
        self._state: dict[str, Any] | None = None  # that was found there, until the run goes on from it
        self._saved_at, self._took = time.monotonic(), 0.0

    def start_or_resume(self, student: SplatModel, task: Task, config: AdaptConfig, spent: float) -> Run:
        """Return the run in the file, or a new one; `spent`: seconds used so far.

        Raises SettingsError (`claim_state_file`, `_read`), OutputError.
        """
        if self._requested is None:
            return Run.start(student, task, config, spent)
        refuse_output(self._requested, overwrite=True, is_file=True)
        try:
            self.file = claim_state_file(self._requested, self._whose)
        except OSError as error:
            warn(f"{self._requested} cannot be written ({error.strerror}), so that this run could not be resumed")
        state, self._state = self._state, None
        if state is None:
            try:
                return Run.start(student, task, config, spent)
            except BaseException:  # Ctrl-C too: its traceback would hold the lock, so that a folder without a state would stay
                self._release()
                raise
        try:
            return load_run(state, student, task, config)
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            if others := _of_another_version(state):
                raise SettingsError(f"{self._path}: this state {others}, or delete it to start anew") from error
            raise SettingsError(f"{self._path}: this state of a run is incomplete; delete it to start anew ({error})") from error

    def _whose(self, path: Path) -> str:
        """Keep the state in a file and return "" if it belongs to this run; else say whose it is, and what to do with it."""
        state = _read(path)
        if isinstance(state, dict) and state.get("fingerprint") == self._fingerprint:
            self._state = state
            return ""
        return _of_another_version(state) or "belongs to another base, settings or views; repeat the run with those"

    @property
    def _path(self) -> Path | None:
        return None if self.file is None else self.file.path

    def save_if_due(self, run: Run) -> None:
        """Save the state if the last save was long ago."""
        began = time.monotonic()
        if began - self._saved_at >= SAVE_EVERY_S * max(1.0, self._took / QUICK_SAVE_S):
            self.save(run)
            self._saved_at = time.monotonic()
            self._took = self._saved_at - began

    def save(self, run: Run) -> None:
        """Save the state, if a file was requested. A full disk does not end the run."""
        if self._path is None:
            return
        try:
            save_run(run, self._path, self._fingerprint)
        except OutputError as error:
            warn(f"the run continues, but could not be resumed if it were killed: {error}")

    def remaining_file(self) -> StateFile | None:
        """The state file of a run that has ended, which is needed until its model is saved; None if none was written."""
        if self.file is not None and not self.file.path.exists():
            self._release()
            self.file = None
        return self.file

    def _release(self) -> None:
        if self.file is not None:
            self.file.release()

    def save_and_stop(self, run: Run) -> NoReturn:
        """Save the state and raise Interrupted. Raises OutputError if the state cannot be written."""
        if self._path is None:
            raise Interrupted(f"interrupted at step {run.step}; nothing was written, because no file to resume from was named")
        try:
            save_run(run, self._path, self._fingerprint)
        finally:
            self._release()
        raise Interrupted(f"interrupted at step {run.step}; run the same command again to continue from {self._path}")


def save_run(run: Run, path: Path, fingerprint: str) -> None:
    """Save everything that `load_run` needs. `fingerprint` identifies the base, the settings and the views."""
    state = {
        "fingerprint": fingerprint,
        "versions": versions(),
        "step": run.step,
        "seconds": run.watch.seconds,
        "costs": run.costs.sums(),
        "square_error": float(run.square_error),
        "rows_changed": run.rows_changed,
        "ended_by": "" if run.ended_by is None else run.ended_by.value,
        "planned": run.planned,
        "reserved": run.reserved,
        "curve": [point.model_dump() for point in run.curve],
        "parameters": {name: tensor.detach() for name, tensor in run.student.parameters().items()},
        "held": getattr(run.student, "held", None),
        "shared": {name: tensor.detach() for name, tensor in run.student.shared_parameters().items()},
        "optimizer": run.optimizer.state_dict(),
        "gradients": None if run.gradients is None else (run.gradients.total, run.gradients.seen),
        "steering": vars(run.steering) | {"best": vars(run.steering.best)},
        "trial": None if run.trial is None else vars(run.trial),
    }
    save_torch(path, state, overwrite=True)


def load_run(state: dict[str, Any], student: SplatModel, task: Task, config: AdaptConfig) -> Run:
    """Return the run of a state that `save_run` wrote; its parameters replace those of `student`.

    Raises what an incomplete state makes Python and torch raise: KeyError, TypeError, ValueError, ...
    """
    kinds = {"step": int, "planned": int, "seconds": float, "reserved": float, "square_error": float, "rows_changed": bool, "ended_by": str}
    for name, kind in kinds.items():
        if not isinstance(state[name], kind):
            raise TypeError(f"{name} must be of type {kind.__name__}")
    device, still = student.parameters()["means"].device, [name for name, tensor in student.parameters().items() if not tensor.requires_grad]
    Snapshot(state["parameters"], state["shared"]).to(device).put_into(student, anew=state["rows_changed"])
    for name in still:  # as in an uninterrupted run, whose steps are others with a gradient more
        student.parameters()[name].requires_grad_(False)
    if state["held"] is not None:
        student.held = state["held"].to(device)  # type: ignore[attr-defined]  # of a model that follows its splats
    optimizer = make_optimizer(student, config, pixel=1.0)  # the state holds the actual rates
    optimizer.load_state_dict(state["optimizer"])
    gradients = ScreenGradients.of(student.parameters()["means"], config) if state["gradients"] else None
    if gradients is not None:
        gradients.total, gradients.seen = (tensor.to(device) for tensor in state["gradients"])
    steering = Steering(**{**state["steering"], "best": Snapshot(**state["steering"]["best"]).to(device)})
    return Run(
        student, optimizer, Stopwatch(seconds=state["seconds"]), gradients, steering, _trial(state["trial"], device), state["step"],
        [CurvePoint(**point) for point in state["curve"]], state["square_error"], state["rows_changed"],
        Costs(earlier=tuple(state["costs"]), motion=lambda: task.follow.seconds, device=device),
        End(state["ended_by"]) if state["ended_by"] else None,
        reserved=state["reserved"], planned=state["planned"],
    )  # fmt: skip


def _trial(state: dict[str, Any] | None, device: torch.device) -> Trial | None:
    if state is None:
        return None
    before = state["before"] and {name: tensor.to(device) for name, tensor in state["before"].items()}
    return Trial(**{**state, "before": before})


def _of_another_version(state: Any) -> str:
    """That a state was left by another version, in which settings may be others, in words; "" if it was not."""
    if not isinstance(state, dict) or "parameters" not in state or (theirs := state.get("versions")) == (ours := versions()):
        return ""
    told = " and ".join(f"{name} {version}" for name, version in theirs.items()) if isinstance(theirs, dict) else "an older version"
    return f"was left by {told}, and this is {' and '.join(f'{name} {version}' for name, version in ours.items())}; go on with that version"


def _read(path: Path) -> Any:
    try:
        return load_torch(path)
    except CheckpointError as error:
        kind = type(error.__cause__ or error).__name__
        raise SettingsError(f"{path}: not the state of an interrupted run ({kind}); delete it to start anew") from error
