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

# The name, among a model's parameters, of columns that go with their rows when rows are removed, and that never move: an anchor's
# level, for example.
CARRIED = "carried"


@dataclass(frozen=True)
class TrainedScale:
    """The screen filter that a checkpoint was trained with, and how its cameras were sampled."""

    screen_filter: str = "classic"  # a name of backends/filters.py
    eps2d: float = DILATION  # px² of a training pixel
    resolution: float = -1  # INRIA's `-r`: 1, 2, 4, 8 divide the size, -1 caps the width at 1600 px, else a width in px
    background: tuple[float, float, float] | None = None  # linear RGB; None: the checkpoint does not say
    near_plane: float = NEAR_PLANE  # world units
    keeps_filter: bool = False  # an adapted file is for its own project, and keeps this filter; else it is classic, or for a viewer


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

    def gaussians(self, camera: Camera) -> Gaussians:
        """The splats that this camera sees, differentiable in `parameters()`."""

    def parameters(self) -> dict[str, Tensor]:
        """What adaptation may move, by name; row i of each belongs to the same splat. A deformation network is never among them."""

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

    # Optional: a family may offer
    #     refuse_output(path: Path, *, overwrite: bool, networks_move: bool) -> None
    # which raises what `save` would raise for that path, so that nobody works in vain. A family whose rows are splats that look the same
    # to every camera offers
    #     rebuild(form: Callable[[Gaussians], Gaussians]) -> None
    # which holds what `form` makes of its splats instead of them. Without it, splats are never merged. A family that keeps its filter, and
    # whose splats 3DGS can hold without it, offers
    #     fused() -> SplatModel
    #     bare() -> SplatModel
    # The first is what a file for a viewer is made of, the second what a viewer shows of the family's own file. Another whose splats no
    # viewer draws says why, in a sentence without a full stop:
    #     not_in_viewers: str
    # A family whose photographs were exposed differently has
    #     exposures: Exposures

    def row_opacities(self, views: Sequence[Camera]) -> Tensor:
        """[N], 0..1, without gradient: how much each row of the parameters can show; rows that show nothing may be pruned."""

    def to(self, device: torch.device | str) -> SplatModel:
        """A copy on another device."""

    def save(self, path: str | Path, *, provenance: dict[str, Any], overwrite: bool = False) -> Path:
        """Write the model in the format it came in, atomically; return the file written. Raises OutputExists."""


def same_for_all_views(model: SplatModel) -> bool:
    """Whether the model says that every camera sees the same splats, by offering `rebuild`."""
    return hasattr(model, "rebuild")


def why_no_viewer(model: SplatModel) -> str:
    """Why no viewer (`viewers`) draws what a model shows, in a sentence without a full stop; empty where a file can be made for one."""
    if hasattr(model, "fused"):
        return ""
    if told := getattr(model, "not_in_viewers", ""):
        return told
    if not same_for_all_views(model):
        return "its splats differ from view to view or in time, and a viewer's file holds them once and for all"
    return "it says that its files are for its own project alone" if model.trained.keeps_filter else ""


def effects_of(model: SplatModel) -> list[Effect]:
    """What a model does for a camera before any splat is drawn, as its method `effects` says: of `effects.OF_OTHER_MODELS`, those that
    it has. A family that has none needs no such method."""
    return [exposures_of(model).effect(), *getattr(model, "effects", list)()]


def exposures_of(model: SplatModel) -> Exposures:
    """By what training changed the colors for each photograph; nothing in most families."""
    return getattr(model, "exposures", NO_EXPOSURES)
