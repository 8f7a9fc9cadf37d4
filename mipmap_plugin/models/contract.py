"""What third-party families promise, looked at before anything relies on it; what they break is a PluginError that names the family."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import PluginError
from mipmap_plugin.models.base import CARRIED, SplatModel, checked_splats
from mipmap_plugin.plugin_errors import is_third_party, naming


def refuse_broken(model: SplatModel, camera: Camera, *, steps: bool) -> None:
    """Raise PluginError for a model whose copies are no copies, as the base would change with them. `steps`: for splats without gradients, too."""
    if not is_third_party(model):
        return
    family = f"family {model.family!r}"
    with naming(family):
        copied = model.copy()
        own, theirs = ({**each.parameters(), **each.shared_parameters()} for each in (model, copied))
    places = {tensor.untyped_storage().data_ptr() for tensor in own.values() if tensor.numel()}
    if shared := [name for name, tensor in theirs.items() if tensor.untyped_storage().data_ptr() in places]:
        raise PluginError(f"{family}: copy() shares {', '.join(shared)} with the model itself, which adaptation would change; clone the tensors")
    fixed = [name for name, tensor in copied.parameters().items() if name != CARRIED and not (tensor.is_leaf and tensor.requires_grad)]
    if fixed:
        raise PluginError(f"{family}: copy() has to return parameters that are leaves and require gradients; {', '.join(fixed)} cannot be optimized")
    if not steps:
        return
    with naming(family):
        splats = checked_splats(copied, camera)
    if len(splats) and not any(tensor.requires_grad for tensor in vars(splats).values() if isinstance(tensor, Tensor)):
        raise PluginError(f"{family}: gaussians() returned splats without gradients; make them of parameters() by torch's operations, not detached")


def row_opacities(model: SplatModel, views: Sequence[Camera]) -> Tensor:
    """The model's `row_opacities`, [N]."""
    opacities: Any = model.row_opacities(views)
    rows = len(model.parameters()["means"])
    if not isinstance(opacities, Tensor) or tuple(opacities.shape) != (rows,):
        got = f"a tensor {list(opacities.shape)}" if isinstance(opacities, Tensor) else f"a {type(opacities).__name__}"
        wanted = f"{rows} numbers, one for each row of its parameters"
        raise PluginError(f"family {model.family!r}: row_opacities() has to return {wanted}; it returned {got}")
    return opacities


def save(model: SplatModel, path: Path, provenance: dict[str, Any], *, overwrite: bool = False) -> Path:
    """The file that the model is saved to."""
    saved: Any = model.save(path, provenance=provenance, overwrite=overwrite)
    if not isinstance(saved, (str, Path)):
        wrong = f"save() has to return the path of the file that it wrote; it returned a {type(saved).__name__}"
        raise PluginError(f"family {model.family!r}: {wrong}, so that {path} is left without a report")
    return Path(saved)
