"""Moving scenes: canonical splats, which are adapted, and a frozen deformation field that moves them to a point in time."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera, every_nth
from mipmap_plugin.effects import Effect
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.splat_transform import is_written
from mipmap_plugin.formats.state_dict import read_state_dict
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import TrainedScale, Traits
from mipmap_plugin.models.detect import detect_as
from mipmap_plugin.models.families import find_family
from mipmap_plugin.models.moving.memory import Changes, Memory
from mipmap_plugin.models.places import network_of
from mipmap_plugin.models.reading import read_splats
from mipmap_plugin.models.vanilla import VanillaModel

# Number of views at whose times opacities are evaluated; each costs one pass through the field.
ENOUGH_MOMENTS = 8

# While splats are adapted, the field is evaluated again once more than MOVED_FAR of them have moved so far that it would move them otherwise by
# MOTION_ERROR target pixels, or have moved by FARTHEST target pixels themselves. With a fourth of the error a scene of 39,000 splats at x1/4 gains
# 0.06 dB, for twice as many evaluations.
MOVED_FAR, MOTION_ERROR, FARTHEST = 0.1, 0.2, 1.0

TIMELESS = "a camera without a time shows the moment 0; a cameras.json holds no times, so adaptation then spreads them over its views"


class Field(Protocol):
    """A deformation field: maps canonical splats to a point in time. Its weights require no gradient and never change."""

    changes_opacities: bool
    is_still: bool  # the field changes no splat, and need not be evaluated
    cost: str  # of one evaluation, counted
    work: float  # of an evaluation at one splat: so many splats are drawn in its time, by the processor's kernels

    def changes(self, means: Tensor, time: float) -> Changes:
        """What it changes at `means` [N, 3] and `time` (0..1), without gradient: that of a mean through the field is left out."""

    def moved(self, canonical: VanillaModel, changes: Changes) -> Gaussians:
        """The splats after such changes, differentiable in the canonical parameters."""

    @property
    def slopes(self) -> Callable[[Tensor, float], Changes] | None:
        """Of means [N, 3] and a time: the derivatives of the moved means in these, beyond those of `moved`, as "means" [N, 3, 3]; None if the
        original's gradient of a mean does not go through the field."""

    def to(self, device: torch.device | str) -> Field:
        """The same field on another device."""


class MovingModel:
    """Canonical splats, stored as in 3DGS, deformed by a frozen field at the time of each camera."""

    held: Tensor | None = None  # [N, 3]: where the field is evaluated; None: at the means

    def __init__(self, family: str, canonical: VanillaModel, field: Field, memories: Sequence[Memory] = ()) -> None:
        """`memories`: those of a model with the same field: of its changes, and of its slopes if it has any."""
        self.family, self.canonical, self.field = family, canonical, field
        self._share(memories or _memories_of(field))
        self.source, self.folder, self.digest, self.notes = canonical.source, canonical.folder, canonical.digest, canonical.notes

    def __getstate__(self) -> dict[str, Any]:
        """For `pickle` and `copy.deepcopy`: without what is known of the field, which locks guard."""
        return {name: value for name, value in vars(self).items() if name not in ("_memories", "_memory", "_slopes")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._share(_memories_of(self.field))

    def _share(self, memories: Sequence[Memory]) -> None:
        self._memory, *self._slopes = self._memories = memories

    @property
    def trained(self) -> TrainedScale:
        return self.canonical.trained

    @trained.setter
    def trained(self, trained: TrainedScale) -> None:
        self.canonical.trained = trained

    def __len__(self) -> int:
        return len(self.canonical)

    @property
    def moves(self) -> bool:
        """Whether the splats depend on time; `adaptation.views.moments` then distributes times over cameras that have none."""
        return not self.field.is_still

    @property
    def work(self) -> float:
        """How many splats are drawn in the time that the field takes for one."""
        return self.field.work

    @property
    def traits(self) -> Traits:
        effect = Effect("time", self.moves, "a field moves the splats" if self.moves else "the field changes no splat", self.field.cost)
        why = "a network moves its splats, which none of the viewers supports"
        return Traits(moves=self.moves, no_viewer=why, exposures=self.canonical.traits.exposures, effects=(effect,))

    def gaussians(self, camera: Camera) -> Gaussians:
        """All splats at the time of `camera`, 0 if it has none."""
        if not self.moves:
            return self.canonical.gaussians()
        means, time = self.parameters()["means"], camera.time or 0.0
        place = means.detach() if self.held is None else self.held
        gaussians = self.field.moved(self.canonical, self._memory(place, time))
        if self._slopes and (self.held is not None or (means.requires_grad and torch.is_grad_enabled())):
            added = torch.einsum("nij,nj->ni", self._slopes[0](place, time)["means"], means - place)
            return replace(gaussians, means=gaussians.means + added)
        return gaussians

    def reach(self, pixel: float) -> float:
        """How far splats may move until the field would move them noticeably otherwise. This and `pixel`, a target pixel's size: in world units."""
        slope = self._memory.slope(self.parameters()["means"].detach(), pixel)
        return MOTION_ERROR * pixel / max(slope, MOTION_ERROR / FARTHEST)

    @torch.no_grad()
    def follow(self, reach: float) -> float:
        """From now on, evaluate the field at the means as they are, if many have moved farther than `reach` since it was last done.

        Between two such moments the splats move as the field moves the places where it was evaluated, and along its slopes if it has any.
        Returns how much of `reach` these many have moved, 0..1.
        """
        means, moved = self.parameters()["means"].detach(), math.inf
        if self.held is not None:
            distances = (means - self.held).norm(dim=1)
            moved = float(distances.kthvalue(max(1, round((1 - MOVED_FAR) * len(distances)))).values) / reach
        if moved > 1:
            self.held, moved = means.clone(), 0.0
        return moved

    def knows(self, time: float) -> bool:
        """Whether the splats at `time`, 0..1, are known without an evaluation."""
        means = self.parameters()["means"].detach() if self.held is None else self.held
        return all(memory.knows(means, time) for memory in self._memories)

    @property
    def spent(self) -> tuple[float, float]:
        """Seconds of all evaluations of the field so far, also of the model's copies; and of one at a moment, 0 before there was one."""
        each = sum(memory.seconds / max(1, memory.evaluations) for memory in self._memories)
        return sum(memory.seconds for memory in self._memories), each

    def keep_motions(self, rows: Tensor) -> None:
        """Keep what is known of the motions of these `rows` [M] of the parameters, ascending, which alone are going to be left."""
        if self.held is not None:
            left = self.held[rows]
            for memory in self._memories:
                memory.keep_of(self.held, rows, left)
            self.held = left

    def parameters(self) -> dict[str, Tensor]:
        """The parameters of the canonical splats, with the names of `VanillaModel`."""
        return self.canonical.parameters()

    def copy(self) -> MovingModel:
        """An independent model whose canonical leaves require gradients; the field, which never changes, is shared."""
        return MovingModel(self.family, self.canonical.copy(), self.field, self._memories)

    def to(self, device: torch.device | str) -> MovingModel:
        return MovingModel(self.family, self.canonical.to(device), self.field.to(device))

    def replace_parameters(self, parameters: dict[str, Tensor]) -> None:
        if self.held is not None and len(self.held) != len(parameters["means"]):
            self.held = None
        self.canonical.replace_parameters(parameters)

    def shared_parameters(self) -> dict[str, Tensor]:
        """None: the field is frozen."""
        return {}

    def reshape(self, form: Callable[[Gaussians], tuple[Tensor, Tensor]], views: Sequence[Camera] = ()) -> None:
        """Reshape the canonical splats in place; the field deforms the result."""
        self.canonical.reshape(form, views)

    @torch.no_grad()
    def row_opacities(self, views: Sequence[Camera]) -> Tensor:
        """The largest opacity of each splat, [N], 0..1, at the times of some of `views`, of which at least one is required."""
        if not (self.moves and self.field.changes_opacities):
            return self.canonical.row_opacities()
        some = every_nth(views, ENOUGH_MOMENTS)
        return torch.stack([self.gaussians(view).opacities for view in some]).amax(0)

    def refuse_output(self, path: Path, *, overwrite: bool, networks_move: bool = False) -> None:
        """Check `path` as `save` would. Raises SettingsError, OutputExists, OutputError."""
        if path.suffix.lower() == ".ply" or is_written(path):
            reason = "has no room for the network that moves its splats; leave out the ending, and a folder is written"
            raise SettingsError(f"{path}: {'a PLY' if path.suffix.lower() == '.ply' else 'this format'} {reason}")
        self.canonical.refuse_output(path, overwrite=overwrite)

    def save(self, path: str | Path, *, provenance: dict[str, Any], overwrite: bool = False) -> Path:
        """Write a model folder, with a byte-for-byte copy of the network for the iteration of the splats; return the PLY written.

        Raises SettingsError for a path that ends in .ply, OutputExists, and OutputError if a file cannot be written.
        """
        self.refuse_output(Path(path), overwrite=overwrite)
        return self.canonical.save(path, provenance=provenance, overwrite=overwrite, companions=self._copy_network)

    def _copy_network(self, ply: Path) -> None:
        if self.source is None:
            raise SettingsError("a moving scene that was made in memory has no network file to save; load it from a model folder")
        network = network_of(ply, self.family)
        network.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(network_of(self.source, self.family), network)


def _memories_of(field: Field) -> Sequence[Memory]:
    changes = Memory(lambda means, time: field.changes(means, time))
    return (changes,) if field.slopes is None else (changes, Memory(field.slopes))


def read_canonical(path: str | Path, iteration: int | None, family: str) -> tuple[VanillaModel, Path, dict[str, Tensor]]:
    """The canonical splats of a moving scene, the file of their network, and its weights by name. Raises CheckpointError."""
    checkpoint = detect_as(path, (family,), iteration=iteration)
    network = network_of(checkpoint.path, family)
    weights = read_state_dict(network)
    canonical, title = read_splats(checkpoint, VanillaModel, network), find_family(family).title
    canonical.notes += [f"the network that moves the splats ({title}) is frozen: they adapt as they are before they move", TIMELESS]
    return canonical, network, weights
