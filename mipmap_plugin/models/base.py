"""The contract of a model: a checkpoint of any family, which returns Gaussians for a camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import NEAR_PLANE, Effect, Effects
from mipmap_plugin.errors import PluginError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.exposure import NO_EXPOSURES, Exposures
from mipmap_plugin.models.hosts import Capture
from mipmap_plugin.screen_filters import DILATION

# Name, among a model's parameters, of values that are never optimized but removed with their rows, such as an anchor's level.
CARRIED = "carried"

# What the rows of most models are.
SPLATS = "splats"

# Names of effects of models.
TIME, BY_VIEW = "time", "view-dependent geometry"


@dataclass(frozen=True)
class TrainedScale:
    """The screen filter and the sampling rate that a checkpoint was trained with.

    Attributes:
        screen_filter: "classic", "antialiased", "mip", or another name of `screen_filters`.
        eps2d: The variance that the filter adds, px² of a training pixel.
        resolution: INRIA's `-r`: 1, 2, 4, 8 divide the size, -1 caps the width at 1600 px, else a width in px.
        background: RGB, 0..1; None: the checkpoint does not say.
        near_plane: Depth up to which splats were not drawn, world units.
        keeps_filter: Files of the family need this filter, so that without a viewer they are for the original project only.
        up: The vertical of the world, where the project turns its scenes, or as the user says; None: not known.
    """

    screen_filter: str = "classic"
    eps2d: float = DILATION
    resolution: float = -1
    background: tuple[float, float, float] | None = None
    near_plane: float = NEAR_PLANE
    keeps_filter: bool = False
    up: tuple[float, float, float] | None = None

    def told(self) -> str:
        """The screen filter in words: "classic, 0.3 px²"."""
        return f"{self.screen_filter}, {self.eps2d:g} px²"

    def drawn_with(self, target: Effects) -> TrainedScale:
        """Of splats that were adapted to another screen filter."""
        return replace(self, screen_filter=target.screen_filter, eps2d=target.eps2d)


@dataclass(frozen=True)
class Traits:
    """Properties of a model. No other code depends on its family.

    Attributes:
        same_for_all_views: Rows are splats, the same for every camera: the model has `rebuild`, and splats may be merged.
        plain: The parameters are those of 3DGS, activated as there, so that a backend may move them itself (`Backend.stepper`).
        moves: Gaussians depend on the camera's time.
        filtered: Each splat has a 3D filter, which only the original project's viewer applies: the model has `fused` and `bare`.
        placed: Trained in a coordinate frame or at an image size of its own: the model has `as_trained`.
        no_viewer: Why no viewer (`viewers`) can draw the splats, a sentence without a full stop; empty if one can.
        exposures: The trained color transformation of each photograph.
        effects: Those of `effects.MODEL_EFFECTS` that the model simulates.
        rows: What a row of its parameters is, in the plural; another word than "splats" where `gaussians` may return more splats than rows, or fewer.
        thins: Some rows can be left out, for others to learn to show what they did: the model has `thin`.
        shrink_option: The option of cfg_args that tells its own project how much smaller pictures are than in training; empty if none does.
    """

    same_for_all_views: bool = False
    plain: bool = False
    moves: bool = False
    filtered: bool = False
    placed: bool = False
    no_viewer: str = ""
    exposures: Exposures = NO_EXPOSURES
    effects: tuple[Effect, ...] = ()
    rows: str = SPLATS
    thins: bool = False
    shrink_option: str = ""


# The parameters of 3DGS.
OF_3DGS = ("means", "scales", "quats", "opacities", "sh0", "shN")

# Allowed names of parameters, each with a learning rate of its own (`config.LearningRates`). The first is required.
PARAMETERS = (*OF_3DGS, "offsets", "features", CARRIED)


@runtime_checkable  # for tools that check arguments by their annotations, such as pydantic
class SplatModel(Protocol):
    """What every model provides to be rendered, adapted and saved. A Protocol: plug-ins need no base class.

    Raw parameters are as the family stores them (log scales, logits); `gaussians` activates them.

    Attributes:
        family: The name of its family: "3dgs", "scaffold", ...
        trained: The screen filter and the sampling rate of the training.
        notes: A list of remarks for the user on how it was read, in sentences.
        source: The file that was read; None: created in memory.
        folder: The model folder around it, whose cameras.json and cfg_args are read; None: there is none.
        digest: sha256 of the file, or of all that it was read from, hexadecimal; "" for a model created in memory, such as a copy.
    """

    family: str
    trained: TrainedScale
    notes: list[str]
    source: Path | None
    folder: Path | None
    digest: str

    @property
    def traits(self) -> Traits:
        """The model's properties, which never change."""

    def gaussians(self, camera: Camera) -> Gaussians:
        """The splats that this camera sees, differentiable in `parameters()`."""

    def parameters(self) -> dict[str, Tensor]:
        """The tensors that adaptation optimizes, by name, with "means" [N, 3] among them. Row i of each belongs to the same splat (or anchor).

        Names are those of PARAMETERS: means, scales, quats, opacities, sh0, shN, offsets, features, and carried, which is never optimized.
        Deformation networks are not included.
        """

    def copy(self) -> SplatModel:
        """An independent model whose parameters are leaves that require gradients; this one does not change."""

    def replace_parameters(self, parameters: dict[str, Tensor]) -> None:
        """Use these tensors themselves, all with the same number of rows, as the model's leaves. Only called on a copy."""

    def shared_parameters(self) -> dict[str, Tensor]:
        """Further tensors that adaptation may optimize and that have no rows, such as the networks of an anchor model; {} for most."""

    def reshape(self, form: Callable[[Gaussians], tuple[Tensor, Tensor]], views: Sequence[Camera]) -> None:
        """Give the splats the scales [M, 3] and opacities [M] that `form` returns for them, as far as the family can.

        Families whose splats exist only for a camera use `views`. Only called on a copy.
        """

    def row_opacities(self, views: Sequence[Camera]) -> Tensor:
        """The largest opacity of each row of the parameters, [N], 0..1, without gradient; rows of low opacity may be pruned."""

    def to(self, device: torch.device | str) -> SplatModel:
        """A copy on another device."""

    def refuse_output(self, path: Path, *, overwrite: bool, networks_move: bool) -> None:
        """Raise what `save` would raise for `path`, as far as it can be known before the work begins: OutputError, OutputExists or SettingsError."""

    def save(self, path: str | Path, *, provenance: dict[str, Any], overwrite: bool = False) -> Path:
        """Write the model in the format that it was read from, atomically; return the file written. Raises OutputExists.

        Where `path` ends in .ply and a viewer can draw the splats, write a PLY of 3DGS.
        """


class Rebuilt(SplatModel, Protocol):
    """A model with the trait `same_for_all_views`.

    Optional: `shared()`, a copy that shares tensors and is never changed in place, and `shares`, whether the model is one. It saves memory.
    """

    def rebuild(self, form: Callable[[Gaussians], Gaussians]) -> None:
        """Replace the splats by those that `form` returns for them, which have quats and scales, but no covariances. Only called on a copy."""


class Thinned(SplatModel, Protocol):
    """A model with the trait `thins`."""

    def thin(self, keep: Tensor) -> None:
        """Leave out the rows where `keep` [N] is False, but for those that its file needs. Only called on a copy."""


class Placed(SplatModel, Protocol):
    """A model with the trait `placed`."""

    def as_trained(self, cameras: Sequence[Camera], capture: Capture) -> list[Camera]:
        """The cameras of a scene in the coordinate frame and at the image size of the training. Raises SceneError."""


class Filtered(SplatModel, Protocol):
    """A model with the trait `filtered`."""

    def fused(self) -> SplatModel:
        """Plain splats into which the 3D filter is baked, for a viewer's file."""

    def bare(self) -> SplatModel:
        """The splats without their 3D filter, as a viewer shows the family's own file."""


def why_no_viewer(model: SplatModel) -> str:
    """Why no viewer (`viewers`) can draw the model, a sentence without a full stop; empty if a file can be written for one."""
    traits = model.traits
    if traits.no_viewer or traits.filtered:
        return traits.no_viewer
    if not traits.same_for_all_views:
        return "its splats differ from view to view or in time, and a viewer's file holds them once and for all"
    return "it says that its files are for its own project alone" if model.trained.keeps_filter else ""


@torch.no_grad()
def count_of(model: SplatModel, view: Camera, scale: float = 1.0) -> int:
    """The number of splats that a camera sees at `scale`. They are made for it only where the rows of the parameters are something else."""
    return len(model.parameters()["means"]) if model.traits.rows == SPLATS else len(model.gaussians(view.zoomed(scale)))


@torch.no_grad()
def means_at(model: SplatModel, view: Camera) -> Tensor:
    """Where the rows of the parameters are at a view's moment, [N, 3] in world units: a field may carry splats far from where they rest.

    Raises PluginError for splats that move and are not those of the rows.
    """
    at_rest = model.parameters()["means"].detach()
    if not model.traits.moves or model.traits.rows != SPLATS:
        return at_rest
    means = model.gaussians(view).means.detach()
    if len(means) != len(at_rest):
        wrong = f"gaussians() returned {len(means):,} splats for {len(at_rest):,} rows of its parameters"
        raise PluginError(f"family {model.family!r}: {wrong}; return one for each, or say by the trait `rows` what else these are")
    return means


def tensors_of(model: SplatModel) -> dict[str, Tensor]:
    """All parameters by name, those without rows too."""
    return {**model.parameters(), **model.shared_parameters()}


def digest_of_parameters(model: SplatModel) -> str:
    """The sha256 of the parameters of a model, hexadecimal: for one that was made in memory, or changed there."""
    digest = sha256()
    for tensor in tensors_of(model).values():
        digest.update(tensor.detach().cpu().numpy().tobytes())
    return digest.hexdigest()


def digest_of_model(model: SplatModel) -> str:
    """What a model is known by: the sha256 of its file, or else of its parameters."""
    return model.digest or digest_of_parameters(model)


def effects_of(model: SplatModel) -> list[Effect]:
    """The effects that the model itself simulates, including exposure. What a model does not report is taken from its other traits."""
    traits = model.traits
    reported = [traits.exposures.effect(), *traits.effects]
    if traits.moves and TIME not in {effect.name for effect in traits.effects}:
        reported.append(Effect(TIME, True, "the splats move", "making the splats for each moment"))
    if not (traits.effects or traits.moves or traits.same_for_all_views or traits.filtered):
        reported.append(Effect(BY_VIEW, True, "the splats are made for each camera", "making the splats for each camera"))
    return reported
