"""The contract of a model: a checkpoint of any family that answers a camera with Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import DILATION, NEAR_PLANE, Effect
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.exposure import NO_EXPOSURES, Exposures
from mipmap_plugin.models.hosts import Taken

# The name, among a model's parameters, of columns that go with their rows when rows are removed, and that never move: an anchor's
# level, for example.
CARRIED = "carried"


@dataclass(frozen=True)
class TrainedScale:
    """The screen filter that a checkpoint was trained with, and how its cameras were sampled."""

    screen_filter: str = "classic"  # a name of splatting/filters.py
    eps2d: float = DILATION  # px² of a training pixel
    resolution: float = -1  # INRIA's `-r`: 1, 2, 4, 8 divide the size, -1 caps the width at 1600 px, else a width in px
    background: tuple[float, float, float] | None = None  # linear RGB; None: the checkpoint does not say
    near_plane: float = NEAR_PLANE  # world units
    keeps_filter: bool = False  # an adapted file is for its own project, and keeps this filter; else it is classic, or for a viewer


@dataclass(frozen=True)
class Traits:
    """What a model is, beyond answering a camera with Gaussians. Nobody asks for anything else about its family."""

    same_for_all_views: bool = False  # its rows are splats, which every camera sees alike: it offers `rebuild`, and they may be merged
    moves: bool = False  # its Gaussians follow the camera's time
    filtered: bool = False  # each of its splats has a 3D filter, which no viewer but its own project's knows: it offers `fused` and `bare`
    placed: bool = False  # it was trained in a frame or at a size of its own: it offers `as_trained`
    no_viewer: str = ""  # why no viewer (`viewers`) draws its splats, in a sentence without a full stop; empty where one does
    exposures: Exposures = NO_EXPOSURES  # what training made of the colors for each photograph
    effects: tuple[Effect, ...] = ()  # what it does for a camera before any splat is drawn, of `effects.OF_OTHER_MODELS`


# The names that parameters may have, each with a learning rate of its own (`config.LearningRates`); the first has to be among them.
PARAMETERS = ("means", "scales", "quats", "opacities", "sh0", "shN", "offsets", "features", CARRIED)


class SplatModel(Protocol):
    """What any family offers to be rendered, adapted and saved. A Protocol: plug-ins need no base class.

    Raw parameters are as the family stores them (log scales, logits); `gaussians` activates them.
    """

    family: str  # "3dgs", "scaffold", ...
    trained: TrainedScale
    notes: list[str]  # what a person should know about how it was read, in sentences
    source: Path | None  # the file that was read; None: made in memory
    folder: Path | None  # the model folder around it
    digest: str  # sha256 of the file, hexadecimal; "" when made in memory, as a copy is

    @property
    def traits(self) -> Traits:
        """What the model is; it never changes."""

    def gaussians(self, camera: Camera) -> Gaussians:
        """The splats that this camera sees, differentiable in `parameters()`."""

    def parameters(self) -> dict[str, Tensor]:
        """What adaptation may move, by a name of PARAMETERS, "means" [N, 3] among them; row i of each belongs to the same splat (or anchor).
        A deformation network is never among them."""

    def copy(self) -> SplatModel:
        """An independent model with leaf parameters of its own that require gradients; this one stays as it is."""

    def replace_parameters(self, parameters: dict[str, Tensor]) -> None:
        """Take these very tensors, all with the same number of rows, as the model's leaves. Only ever called on a copy."""

    def shared_parameters(self) -> dict[str, Tensor]:
        """What adaptation may move besides and that belongs to no row, such as the networks of an anchor model; {} for most."""

    def reshape(self, form: Callable[[Gaussians], tuple[Tensor, Tensor]], views: Sequence[Camera]) -> None:
        """Give the model's splats the scales [M, 3] and opacities [M] that `form` finds for them, as far as the family can.

        `views` are there for families whose splats exist only for a camera. Only ever called on a copy.
        """

    def row_opacities(self, views: Sequence[Camera]) -> Tensor:
        """[N], 0..1, without gradient: how much each row of the parameters can show; rows that show nothing may be pruned."""

    def to(self, device: torch.device | str) -> SplatModel:
        """A copy on another device."""

    def refuse_output(self, path: Path, *, overwrite: bool, networks_move: bool) -> None:
        """Raise what `save` would raise for that path, as far as it can be known, so that nobody works in vain."""

    def save(self, path: str | Path, *, provenance: dict[str, Any], overwrite: bool = False) -> Path:
        """Write the model in the format it came in, atomically; return the file written. Raises OutputExists."""


class Rebuilt(SplatModel, Protocol):
    """A model with the trait `same_for_all_views`."""

    def rebuild(self, form: Callable[[Gaussians], Gaussians]) -> None:
        """Hold what `form` makes of its splats instead of them. Only ever called on a copy."""


class Placed(SplatModel, Protocol):
    """A model with the trait `placed`."""

    def as_trained(self, cameras: Sequence[Camera], taken: Taken) -> list[Camera]:
        """Views of the photographs' scene in the frame and at the size that the model was trained in. Raises SceneError."""


class Filtered(SplatModel, Protocol):
    """A model with the trait `filtered`."""

    def fused(self) -> SplatModel:
        """Splats that look the same without the 3D filter; what a file for a viewer is made of."""

    def bare(self) -> SplatModel:
        """What a viewer shows of the family's own file: the splats without their filter."""


def lacking(model: Any) -> list[str]:
    """What an object lacks to be a SplatModel, by name; [] for one that is."""
    asked = [*_members(SplatModel)]
    if isinstance(traits := getattr(model, "traits", None), Traits):
        asked += ["rebuild"] * traits.same_for_all_views + ["as_trained"] * traits.placed + ["fused", "bare"] * traits.filtered
    missing = [name for name in asked if not hasattr(model, name)]
    return missing if "traits" in missing or isinstance(traits, Traits) else [*missing, "traits of the type Traits"]


def _members(protocol: type) -> list[str]:
    """The attributes and methods that a protocol asks for."""
    return [*protocol.__annotations__, *(name for name in vars(protocol) if not name.startswith("_"))]


def why_no_viewer(model: SplatModel) -> str:
    """Why no viewer (`viewers`) draws what a model shows, in a sentence without a full stop; empty where a file can be made for one."""
    traits = model.traits
    if traits.no_viewer or traits.filtered:
        return traits.no_viewer
    if not traits.same_for_all_views:
        return "its splats differ from view to view or in time, and a viewer's file holds them once and for all"
    return "it says that its files are for its own project alone" if model.trained.keeps_filter else ""


def effects_of(model: SplatModel) -> list[Effect]:
    """What a model does for a camera before any splat is drawn, its exposures among them."""
    return [model.traits.exposures.effect(), *model.traits.effects]
