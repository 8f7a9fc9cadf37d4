"""An interrupted run on disk: written atomically, read without executing anything, refused when it belongs to another run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from mipmap_plugin.adaptation.curve import CurvePoint, Stopwatch
from mipmap_plugin.adaptation.density import ScreenGradients
from mipmap_plugin.adaptation.loop import Run, Task
from mipmap_plugin.adaptation.optimizer import make_optimizer
from mipmap_plugin.adaptation.views import extent
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.files import new_file
from mipmap_plugin.models.base import SplatModel


def save_run(run: Run, path: Path, fingerprint: str) -> None:
    """Write all that `load_run` needs. `fingerprint` names the base, the settings and the views."""
    state = {
        "fingerprint": fingerprint,
        "step": run.step,
        "seconds": run.watch.seconds,
        "square_error": run.square_error,
        "rows_changed": run.rows_changed,
        "curve": [point.model_dump() for point in run.curve],
        "parameters": {name: tensor.detach() for name, tensor in run.student.parameters().items()},
        "shared": {name: tensor.detach() for name, tensor in run.student.shared_parameters().items()},
        "optimizer": run.optimizer.state_dict(),
        "gradients": None if run.gradients is None else (run.gradients.total, run.gradients.seen),
    }
    with new_file(path, overwrite=True) as temporary:
        torch.save(state, temporary)


def load_run(path: Path, student: SplatModel, task: Task, config: AdaptConfig, fingerprint: str) -> Run:
    """The run that `save_run` wrote, over `student`'s own parameters. Raises SettingsError when it is of another run or unreadable."""
    state = _read(path)
    if state.get("fingerprint") != fingerprint:
        raise SettingsError(f"{path}: it belongs to another base, other settings or other views; repeat those, or delete the file to start anew")
    device = student.parameters()["means"].device
    if state["rows_changed"]:
        student.replace_parameters({name: tensor.to(device).requires_grad_() for name, tensor in state["parameters"].items()})
    else:  # the rows are those of the base, and so are whatever the model carries along by row
        with torch.no_grad():
            for name, tensor in student.parameters().items():
                tensor.copy_(state["parameters"][name])
    with torch.no_grad():
        for name, tensor in student.shared_parameters().items():
            tensor.copy_(state["shared"][name])
    optimizer = make_optimizer(student, config, extent(task.views))
    optimizer.load_state_dict(state["optimizer"])
    gradients = ScreenGradients.of(student.parameters()["means"], config)
    if gradients is not None:
        gradients.total, gradients.seen = (tensor.to(device) for tensor in state["gradients"])
    curve = [CurvePoint(**point) for point in state["curve"]]
    return Run(student, optimizer, Stopwatch(device, state["seconds"]), gradients, state["step"], curve, state["square_error"], state["rows_changed"])


def _read(path: Path) -> dict[str, Any]:
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load fails in many ways on a file that is not its own
        raise SettingsError(f"{path}: this is not the state of an interrupted run ({type(error).__name__}); delete it to start anew") from error
