"""Plain 3D Gaussian splatting: a PLY of 3DGS, or of any program that writes the same columns, with or without a model folder."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SettingsError, ShapeError, warn
from mipmap_plugin.formats.atomic import sha256
from mipmap_plugin.formats.glb import write_glb
from mipmap_plugin.formats.ply import write_ply
from mipmap_plugin.formats.splat_transform import MOST_BANDS, is_written, write_exchange, written_ending
from mipmap_plugin.formats.tags import with_tags
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import TrainedScale, Traits
from mipmap_plugin.models.columns import in_short, to_columns, to_parameters
from mipmap_plugin.models.exposure import NO_EXPOSURES, Exposures
from mipmap_plugin.models.health import LARGEST
from mipmap_plugin.models.hosts import Capture, Host
from mipmap_plugin.models.inria_folder import cfg_args_for, write_folder
from mipmap_plugin.models.outputs import cut_off, finite, refuse_format, refuse_parts, without_place
from mipmap_plugin.models.raw import check, log, logit, moved, raw_parameters
from mipmap_plugin.splatting.bands import joined, neighbors
from mipmap_plugin.splatting.rotations import unit_quaternions

Model = TypeVar("Model", bound="VanillaModel")


@dataclass(frozen=True, eq=False)
class Origin:
    """Where a model was read from, and the contents of its file that are kept unchanged.

    Attributes:
        source: The file; None: created in memory.
        digest: sha256 of its bytes, hexadecimal.
        folder: The model folder around it, whose cameras.json and cfg_args are read; None: there is none.
        iteration: Of a model folder, the one that was read.
        comments: Those of a PLY's header.
        extras: Columns of a PLY that 3DGS does not define, [N] each.
        exposures: The trained color transformation of each photograph.
        host: The other project whose file holds the splats; None: a PLY of 3DGS.
    """

    source: Path | None = None
    digest: str = ""
    folder: Path | None = None
    iteration: int | None = None
    comments: tuple[str, ...] = ()
    extras: dict[str, np.ndarray] = field(default_factory=dict)
    exposures: Exposures = NO_EXPOSURES
    host: Host | None = None


class VanillaModel:
    """N splats that look the same to every camera.

    Raw parameters, named and shaped as gsplat's: means [N, 3], scales [N, 3] log, quats [N, 4] wxyz, opacities [N]
    logit, sh0 [N, 1, 3], shN [N, (degree + 1)**2 - 1, 3]. Only those of a copy require gradients.
    """

    family = "3dgs"
    _no_viewer = ""  # `Traits.no_viewer`

    def __init__(
        self, parameters: dict[str, Tensor], trained: TrainedScale = TrainedScale(), origin: Origin = Origin(), notes: Iterable[str] = ()  # noqa: B008
    ) -> None:
        """A model over these tensors, which are not copied. Raises ShapeError."""
        check(parameters)
        self._parameters = dict(parameters)
        self._origin = origin
        if origin.host:
            self.family = origin.host.family
        self.source, self.folder, self.digest = origin.source, origin.folder, origin.digest
        self.traits = Traits(
            same_for_all_views=True, plain=self._activates_as_3dgs(), placed=origin.host is not None, no_viewer=self._no_viewer,
            exposures=origin.exposures,
        )  # fmt: skip
        self.trained = trained
        self.notes: list[str] = list(notes)
        self.shares = False  # tensors with another model, so that they are replaced and never changed in place

    @classmethod
    def from_gaussians(cls, gaussians: Gaussians, trained: TrainedScale = TrainedScale()) -> VanillaModel:  # noqa: B008
        """A model whose activated splats are `gaussians`, with scales and opacities clamped by `MIN_SCALE` and `OPACITY_MARGIN`."""
        if gaussians.covariances is not None:
            raise SettingsError("Gaussians with covariances cannot be stored as 3DGS parameters; give quaternions and scales")
        return cls(raw_parameters(gaussians), trained)

    @property
    def sh_degree(self) -> int:
        return math.isqrt(self._parameters["shN"].shape[1] + 1) - 1

    def __len__(self) -> int:
        return len(self._parameters["means"])

    @property
    def extras(self) -> dict[str, np.ndarray]:
        """The columns [N] of its file that 3DGS does not define."""
        return dict(self._origin.extras)

    def with_extras(self: Model, extras: dict[str, np.ndarray]) -> Model:
        """The same splats, sharing tensors, with these columns [N] after those of 3DGS."""
        return self._with(self._parameters, replace(self._origin, extras=extras))

    def with_degree(self: Model, degree: int) -> Model:
        """The same splats, sharing tensors, with SH bands up to `degree`: of zeros where they have none, and without those above."""
        held, wanted = self._parameters["shN"].detach(), (degree + 1) ** 2 - 1
        return self._with(self._parameters | {"shN": torch.nn.functional.pad(held[:, :wanted], (0, 0, 0, max(0, wanted - held.shape[1])))})

    def noted(self: Model, note: str) -> Model:
        """The same splats, sharing tensors, with one more note."""
        model = self._with(self._parameters)
        model.notes.append(note)
        return model

    def with_source(self: Model, file: Path) -> Model:
        """The same splats, sharing tensors, with `file` as their source."""
        return self._with(self._parameters, replace(self._origin, source=file, digest=sha256(file)))

    def gaussians(self, camera: Camera | None = None) -> Gaussians:
        """All splats, activated: exp, sigmoid, unit quaternions. `camera` is ignored."""
        return self._activated(joined(self._parameters["sh0"], self._parameters["shN"]))

    def _activates_as_3dgs(self) -> bool:
        """Whether no class derived from this one changes it."""
        return all(getattr(type(self), name) is getattr(VanillaModel, name) for name in ("gaussians", "_activated", "parameters"))

    def _activated(self, sh: Tensor) -> Gaussians:
        """All splats with the coefficients `sh` [N, K, 3]."""
        raw = self._parameters
        return Gaussians(raw["means"], unit_quaternions(raw["quats"]), raw["scales"].exp(), raw["opacities"].sigmoid(), sh)

    def parameters(self) -> dict[str, Tensor]:
        """The raw parameters by name, without copying them."""
        return dict(self._parameters)

    def copy(self: Model) -> Model:
        """An independent model whose parameters are leaves that require gradients; it has no digest, because it may change."""
        held = {name: tensor.detach() for name, tensor in self._parameters.items()}
        copies = {name: copied.clone() if copied is held[name] else copied for name, copied in neighbors(held).items()}
        return self._with({name: tensor.requires_grad_() for name, tensor in copies.items()}, replace(self._origin, digest=""))

    def shared(self: Model) -> Model:
        """A copy that takes no memory until it is reshaped or rebuilt: it shares this model's tensors, which it never changes."""
        model = self._with(self._parameters, replace(self._origin, digest=""))
        model.shares = True
        return model

    def to(self: Model, device: torch.device | str) -> Model:
        """A copy on another device, which requires gradients where this one does."""
        return self._with({name: moved(tensor, device) for name, tensor in self._parameters.items()})

    def keep_rows(self: Model, keep: Tensor) -> Model:
        """A new model of the rows where `keep` [N] is True, extra columns included."""
        extras = {name: column[keep.cpu().numpy()] for name, column in self._origin.extras.items()}
        kept = {name: tensor.detach()[keep].requires_grad_(tensor.requires_grad) for name, tensor in self._parameters.items()}
        return self._with(kept, replace(self._origin, extras=extras))

    def replace_parameters(self, parameters: dict[str, Tensor]) -> None:
        """Use these tensors themselves as leaves, as an optimizer requires. Extra columns are dropped, since rows may differ. Raises ShapeError."""
        check(parameters)
        leaves = {name: tensor if tensor.is_leaf else tensor.detach() for name, tensor in parameters.items()}
        self._parameters, self.shares = {name: leaf.requires_grad_() for name, leaf in leaves.items()}, False
        if self._origin.extras:
            self.notes.append(f"the extra columns {in_short(self._origin.extras)} are dropped, since splats were added or removed")
            self._origin = replace(self._origin, extras={})

    def shared_parameters(self) -> dict[str, Tensor]:
        """None: every parameter belongs to a splat."""
        return {}

    def reshape(self, form: Callable[[Gaussians], tuple[Tensor, Tensor]], views: Sequence[Camera] = ()) -> None:
        """Set the scales [N, 3] and opacities [N] that `form` returns for splats of SH degree 0, on which shapes do not depend.

        In place, so that an optimizer keeps its leaves, unless they are shared. Raises ShapeError.
        """
        scales, opacities = form(self._activated(self._parameters["sh0"]).detach())
        for name, values in {"scales": log(scales), "opacities": logit(opacities)}.items():
            leaf = self._parameters[name]
            if values.shape != leaf.shape:
                raise ShapeError(f"{name}: expected shape {list(leaf.shape)}, got {list(values.shape)}")
            if self.shares:
                self._parameters[name] = values
            else:
                with torch.no_grad():
                    leaf.copy_(values)

    def rebuild(self, form: Callable[[Gaussians], Gaussians]) -> None:
        """Replace the splats by those that `form` returns for them, of any number."""
        before = self.gaussians().detach()
        after = form(before)
        if after is not before:
            self.replace_parameters(raw_parameters(after))

    def save(
        self, path: str | Path, *, provenance: dict[str, Any], overwrite: bool = False, companions: Callable[[Path], Any] = lambda ply: None
    ) -> Path:
        """Write a PLY if `path` ends in .ply, an exchange format (`splat_transform.WRITTEN`), or else a folder, atomically; return the file.

        A model from another project's file is written in its format (`Host.write`). A folder of 3DGS gets the model's iteration,
        cfg_args, cameras and exposures; `companions` is called with the PLY's path to write further files of a family.
        Raises OutputExists, OutputError if the file cannot be written, SettingsError for splats that are not finite.
        """
        path = Path(path)
        self.refuse_output(path, overwrite=overwrite)
        parameters = finite(self._parameters, LARGEST)
        comments = with_tags(self._origin.comments, self.trained.screen_filter, provenance, self.trained.eps2d)
        if is_written(path):
            for lost in filter(None, (without_place(path, self._origin.extras, self.sh_degree), cut_off(path, parameters))):
                warn(lost)
            exchanged = self._columns(parameters | {"shN": parameters["shN"][:, : (MOST_BANDS + 1) ** 2 - 1]})
            if written_ending(path) == ".glb":
                return write_glb(path, exchanged, comments, overwrite=overwrite)
            return write_exchange(path, lambda ply: write_ply(ply, exchanged, comments), overwrite=overwrite)
        if self._origin.host and path.suffix.lower() != ".ply":
            return self._origin.host.write(path, parameters, comments, overwrite=overwrite)
        columns = {**self._columns(parameters), **self._origin.extras}
        if path.suffix.lower() == ".ply":
            return write_ply(path, columns, comments, overwrite=overwrite)

        def write(ply: Path) -> None:
            write_ply(ply, columns, comments)
            companions(ply)

        cfg_args = cfg_args_for(self.folder, path, self.trained, self.sh_degree)
        return write_folder(path, self.folder, cfg_args, self._origin.iteration, overwrite, write)

    def refuse_output(self, path: Path, *, overwrite: bool, networks_move: bool = False) -> None:
        """Check `path` as `save` would. Raises OutputExists, OutputError, SettingsError."""
        if is_written(path):
            refuse_format(path, self.trained, self._parameters)
        is_file = path.suffix.lower() == ".ply" or is_written(path)
        host = None if is_file else self._origin.host
        holds = host.holds(path) if host else None if is_file else "point_cloud"
        refuse_parts(path, overwrite, self.source, self.folder, holds)

    def row_opacities(self, views: Sequence[Camera] = ()) -> Tensor:
        """The opacities [N], 0..1, without gradient; the same for all views."""
        return self._parameters["opacities"].detach().sigmoid()

    def as_trained(self, cameras: Sequence[Camera], capture: Capture) -> list[Camera]:
        """The cameras of a scene in the coordinate frame and at the image size of the training."""
        if self._origin.host is None:
            return list(cameras)
        return self._origin.host.as_trained(cameras, capture, self._parameters["means"].detach())

    @staticmethod
    def parameters_of(columns: Mapping[str, np.ndarray], path: Path) -> dict[str, Tensor]:
        """Raw parameters from the columns of the family's PLY at `path`. Raises CheckpointError."""
        return to_parameters(columns, path)

    def _columns(self, parameters: dict[str, Tensor]) -> dict[str, np.ndarray]:
        """The columns of the family's PLY for `parameters`."""
        return to_columns(parameters)

    def _with(self: Model, parameters: dict[str, Tensor], origin: Origin | None = None) -> Model:
        return type(self)(parameters, self.trained, origin or self._origin, self.notes)
