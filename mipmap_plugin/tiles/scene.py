"""A scene that is adapted in tiles, as each of its jobs opens it: the base on the disk, the cores, the views, and how all is drawn."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.amount import affordable_for
from mipmap_plugin.adaptation.optimization.validation import split_validation
from mipmap_plugin.adaptation.seeing import seeing
from mipmap_plugin.adaptation.target.resize import fitting
from mipmap_plugin.adaptation.views import choose_views, orbit_of, orbited
from mipmap_plugin.backends import choose_backend
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import CheckpointError, SettingsError
from mipmap_plugin.formats.atomic import sha256
from mipmap_plugin.formats.ply_rows import PlyRows
from mipmap_plugin.formats.torch_file import load_torch, save_torch
from mipmap_plugin.jobs.base import COLORS, Base
from mipmap_plugin.models import Checkpoint, detect
from mipmap_plugin.models.columns import extra_names
from mipmap_plugin.models.exposure import read_exposures
from mipmap_plugin.models.health import MIN_DISTRIBUTION, coarse, doubts, dropped, examine, refuse_few
from mipmap_plugin.models.inria_folder import read_options, trained_scale
from mipmap_plugin.models.surfels import SurfelModel, flat_trained
from mipmap_plugin.models.vanilla import Origin, VanillaModel
from mipmap_plugin.scenes import load_scene
from mipmap_plugin.scenes.trajectories import Orbit
from mipmap_plugin.tiles.cut import Tree, cut
from mipmap_plugin.tiles.folder import BASE, CUT
from mipmap_plugin.tiles.slabs import Painter
from mipmap_plugin.tiles.splats import CHUNK, Splats
from mipmap_plugin.tiles.store import Store, write_pieces
from mipmap_plugin.tiles.sweeps import Sweep, sweeps, views_of
from mipmap_plugin.wrap import Wrapped, wrap_model

# The families whose splats lie in a PLY row by row, each the same for all views.
KINDS: dict[str, type[VanillaModel]] = {"3dgs": VanillaModel, "2dgs": SurfelModel}

# Splats from which is told what the scene needs of a backend.
SAMPLE = 1000


@dataclass(frozen=True, eq=False)
class Views:
    """The views of the base scale, each with its number as its name."""

    adapted: Sequence[Camera]
    steering: Sequence[Camera]
    choosing: Sequence[Camera]
    note: str


def find_splats(path: Path) -> tuple[Checkpoint, type[VanillaModel]]:
    """The checkpoint at `path`, and what reads its columns. Raises CheckpointError; SettingsError for a family that cannot be cut."""
    checkpoint = detect(path)
    kind = KINDS.get(checkpoint.family)
    if kind is None or checkpoint.path.suffix.lower() != ".ply":
        raise SettingsError(
            f"{checkpoint.path}: a checkpoint of {checkpoint.family} cannot be cut into tiles, only the PLY of 3DGS or 2DGS, whose splats are"
            " the same for all views and stand by themselves; leave --tiles out"
        )
    return checkpoint, kind


def make_cut(path: Path, tiles: int, folder: Path) -> None:
    """Read the splats at `path` once, and leave them and their cut into cores in `folder`, as all jobs need them. Raises CheckpointError."""
    checkpoint, kind = find_splats(path)
    rows = PlyRows(checkpoint.path)
    found = _Found()
    write_pieces(folder / BASE, len(rows), (found(kind, part, rows.path) for part in _read(rows)))
    splats = Splats.of(kind, [Store(folder / BASE)])
    valid = torch.cat(found.valid)
    refuse_few(~valid, checkpoint.path)
    kept = valid.nonzero()[:, 0]
    if len(kept) < tiles:
        raise CheckpointError(f"{checkpoint.path} has {len(kept):,} splats, which cannot be cut into {tiles} tiles; give fewer")
    cores, tree = cut(splats.places, kept, tiles)
    if not found.drawn:
        raise CheckpointError(f"{checkpoint.path}: every splat has an opacity below 1/255, so none is drawn; the training or the export failed")
    told = found.doubts(len(rows))
    for doubt in told:
        warnings.warn(f"{checkpoint.path}: {doubt}", stacklevel=2)
    told += [] if valid.all() else [dropped(~valid, "splats", "not finite once activated", checkpoint.path)]
    degree_at = found.degree_at if found.highest >= 0 else int(kept[0])
    sample = torch.cat([kept[:: -(-len(kept) // SAMPLE)], torch.tensor([degree_at])]).unique()
    places = torch.where(valid[:, None], splats.places, torch.nan)  # an invalid splat is seen by no camera
    stored = {"places": places, "cores": cores, "tree": tree, "sample": sample, "digest": sha256(checkpoint.path),
              "extras": [name for name in rows.header.vertex.names if name in found.extras], "doubts": told}  # fmt: skip
    save_torch(folder / CUT, stored, overwrite=True)


def _read(rows: PlyRows) -> Iterator[dict[str, Any]]:
    """The columns of a PLY, some rows at a time."""
    for start in range(0, len(rows), CHUNK):
        yield rows.columns(slice(start, start + CHUNK))
        rows.release()


class _Found:
    """Which splats are finite, whether one is drawn, one that has the highest SH band that is not zero, and columns that tiles do not hold."""

    def __init__(self) -> None:
        self.valid: list[Tensor] = []
        self.degree_at, self.highest, self.drawn = 0, -1, False
        self.rounded, self.step = 0, 0.0  # as of `Health`; the largest step
        self.looks: list[tuple[bool, bool]] = []  # whether scales look linear, and opacities activated, where so many splats say anything
        self.extras: set[str] = set()

    def __call__(self, kind: type[VanillaModel], columns: dict[str, Any], path: Path) -> dict[str, Tensor]:
        """Examine the next splats, and return their raw parameters."""
        parameters = kind.parameters_of(columns, path)
        self.extras.update(extra_names(columns))
        health = examine(kind(parameters))
        valid = ~health.invalid
        self.drawn |= health.invisible < health.splats
        self.rounded, self.step = self.rounded + health.rounded, max(self.step, health.step)
        used = (parameters["shN"].abs().amax(dim=2) > 0) & valid[:, None]
        if used.any():
            row, band = used.nonzero()[used.nonzero()[:, 1].argmax()].tolist()
            if band > self.highest:
                self.degree_at, self.highest = sum(map(len, self.valid)) + row, band
        self.valid.append(valid)
        if health.splats >= MIN_DISTRIBUTION:
            self.looks.append((health.scales_look_linear, health.opacities_look_activated))
        return parameters

    def doubts(self, splats: int) -> list[str]:
        """As of `Health`, of all splats."""
        linear, activated = map(all, zip(*self.looks, strict=True)) if self.looks else (False, False)
        return doubts(coarse(self.rounded, splats, self.step), linear, activated)


class TiledScene:
    """A scene and its cores."""

    def __init__(self, base: Base, scale: float, viewer: str | None, config: AdaptConfig, folder: Path) -> None:
        """`folder`: holds what `make_cut` wrote. Raises CheckpointError, SceneError, SettingsError, BackendUnavailable."""
        self.scale, self.viewer = scale, viewer
        self.checkpoint, self.kind = find_splats(base.checkpoint)
        stored: dict[str, Any] = load_torch(folder / CUT)
        self.base = Splats(self.kind, [Store(folder / BASE)], stored["places"])
        self.cores: list[Tensor] = stored["cores"]
        self.tree: Tree = stored["tree"]
        self.comments = PlyRows(self.checkpoint.path).header.comments
        self.doubts: list[str] = stored["doubts"]  # about the base's splats, in sentences
        self.extras: list[str] = stored["extras"]  # columns of the base that tiles do not hold
        self.digest: str = stored["digest"]
        self.options, _ = read_options(self.checkpoint.folder)
        self.wrapped = self._wrapped(base, stored["sample"])
        targets = self.wrapped.targets(viewer)
        self.target: Effects = next(iter(targets.values()))
        self.backend, self.backend_note = self._backend(base.backend)
        self.asked_steps, self.config = config.steps, self._affordable(config)

    def _wrapped(self, base: Base, sample: Tensor) -> Wrapped:
        """Some of the splats with the cameras of all."""
        checkpoint, options = self.checkpoint, self.options
        comments = self.comments
        origin = Origin(
            checkpoint.path, self.digest, checkpoint.folder, checkpoint.iteration, comments, {}, read_exposures(checkpoint.folder)
        )  # fmt: skip
        trained = trained_scale(options, comments)
        if self.kind is SurfelModel:
            trained = flat_trained(trained)
        model = self.kind(self.base.parameters(sample), trained, origin)
        scene = None if base.cameras is None else load_scene(base.cameras, options)
        color = COLORS[base.background]
        return wrap_model(model, cameras=scene, backend="auto", background=color, screen_filter=base.screen_filter, up=base.up)

    def _backend(self, name: str) -> tuple[Any, str]:
        splats = self.wrapped.model.gaussians(self.wrapped.any_camera())
        return choose_backend(name, Needs.of(splats, self.base_effects, gradients=True), Needs.of(splats, self.target, gradients=True))

    def _affordable(self, config: AdaptConfig) -> AdaptConfig:
        """The settings with no more steps than a scene of this size can have, as without tiles."""
        config = fitting(config, self.base_effects)
        return affordable_for(config, self.base.places[:, :3], self.wrapped.cameras, self.target.near_plane)

    @cached_property
    def base_effects(self) -> Effects:
        """How the base is rendered at its own scale."""
        return self.wrapped.effects()

    @cached_property
    def orbit(self) -> Orbit:
        """What views without cameras go around: all splats."""
        return orbit_of(self.wrapped.model, self.wrapped.trained.up, self.base.places[:, :3])

    @cached_property
    def views(self) -> Views:
        """The views of the whole scene, the same as without tiles."""
        cameras, orbit = seeing(self.wrapped.cameras, self.base.places[:, :3], self.target.near_plane), self.orbit
        if not cameras and self.config.views != "orbit":
            warnings.warn(orbited(self.checkpoint.path, orbit), stacklevel=1)
        chosen, note = choose_views(cameras, orbit, self.config)
        adapted, validation = split_validation(cameras, chosen, orbit, self.scale, self.config)
        note += f", {len(chosen) - len(adapted)} of them kept for validation" if len(adapted) < len(chosen) else ""
        named = [replace(view, name=str(number)) for number, view in enumerate([*adapted, *validation])]
        judged = named[len(adapted) :]
        return Views(named[: len(adapted)], judged[::2], judged[1::2], note)

    @cached_property
    def sweeps(self) -> list[Sweep]:
        """The parts of the run, as planned."""
        return sweeps(self.config)

    def sweep_views(self, sweep: Sweep) -> list[Camera]:
        """The views of a sweep's halos, which are all that it adapts to."""
        planned = self.sweeps[sweep.planned]
        return views_of(self.views.adapted, self.config, planned.first, planned.end)

    @cached_property
    def used_views(self) -> list[Camera]:
        """The views of all sweeps, and those of validation."""
        return [*views_of(self.views.adapted, self.config, 0, self.config.steps), *self.views.steering, *self.views.choosing]

    def at(self, scale: float, config: AdaptConfig) -> TiledScene:
        """The same scene at another scale, for its truths only: its views, and the base that they show. It shares this one's memory."""
        other = copy(self)
        other.scale, other.config = scale, self._affordable(config)
        for name in ("views", "sweeps", "used_views"):
            other.__dict__.pop(name, None)
        return other

    def for_target(self, parameters: dict[str, Tensor]) -> VanillaModel:
        """A model of some splats, as it is saved for the target; its parameters are leaves that require gradients."""
        return self.kind(parameters, self.wrapped.model.trained.drawn_with(self.target)).copy()

    def painter(self, effects: Effects) -> Painter:
        """What draws splats from the disk."""
        return Painter(self.backend, effects)


def opened(base: Base, scale: float, viewer: str | None, config: AdaptConfig, folder: Path) -> TiledScene:
    """A scene whose cut lies in `folder`, kept open for the next job of the same process."""
    status = (folder / CUT).stat()
    return _opened(base, scale, viewer, config.model_dump_json(), folder, (status.st_mtime_ns, status.st_ino))


def close_opened() -> None:
    """Let go of the scene that is kept open, whose files are to be deleted."""
    _opened.cache_clear()


@lru_cache(maxsize=1)
def _opened(base: Base, scale: float, viewer: str | None, config: str, folder: Path, _: tuple[int, int]) -> TiledScene:
    return TiledScene(base, scale, viewer, AdaptConfig.model_validate_json(config), folder)
