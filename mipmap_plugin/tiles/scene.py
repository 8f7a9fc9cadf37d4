"""A scene that is adapted in tiles, as each of its jobs opens it: the base on the disk, the cores, the views, and how all is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from torch import Tensor

from mipmap_plugin.adaptation.optimization.amount import affordable_for
from mipmap_plugin.adaptation.target.resize import fitting
from mipmap_plugin.adaptation.views.of_run import views_of_run
from mipmap_plugin.adaptation.views.remarks import orbited
from mipmap_plugin.adaptation.views.shown import seeing
from mipmap_plugin.adaptation.views.viewpoints import Viewpoints, orbit_of
from mipmap_plugin.backends import choose_backend
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import warn
from mipmap_plugin.formats.ply_rows import PlyRows
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.jobs.base import COLORS, Base
from mipmap_plugin.jobs.job import Job
from mipmap_plugin.models.exposure import read_exposures
from mipmap_plugin.models.inria_folder import read_options, trained_scale
from mipmap_plugin.models.surfels import SurfelModel, flat_trained
from mipmap_plugin.models.vanilla import Origin, VanillaModel
from mipmap_plugin.scenes import Scene
from mipmap_plugin.tiles.cut import Tree
from mipmap_plugin.tiles.folder import BASE, CUT
from mipmap_plugin.tiles.reading import find_splats
from mipmap_plugin.tiles.slabs import Painter
from mipmap_plugin.tiles.splats import Splats
from mipmap_plugin.tiles.store import Store
from mipmap_plugin.tiles.sweeps import Sweep, sweeps, views_of
from mipmap_plugin.wrap import WrapOptions, Wrapped, wrap_unchecked


@dataclass(frozen=True, eq=False)
class Views:
    """The views of the base scale, each with its number as its name."""

    adapted: Sequence[Camera]
    steering: Sequence[Camera]
    choosing: Sequence[Camera]
    note: str


class TiledScene:
    """A scene and its cores."""

    def __init__(self, base: Base, scale: float, viewer: str | None, config: AdaptConfig, folder: Path) -> None:
        """`folder`: has what `make_cut` and the jobs wrote. Raises CheckpointError, SceneError, SettingsError, BackendUnavailable."""
        self.scale, self.viewer, self.folder = scale, viewer, folder
        self.checkpoint, self.kind = find_splats(base.checkpoint)
        stored: dict[str, Any] = load_torch(folder / CUT)
        self.base = Splats(self.kind, [Store(folder / BASE)], stored["places"])
        self.cores: list[Tensor] = stored["cores"]
        self.tree: Tree = stored["tree"]
        self.comments = PlyRows(self.checkpoint.path).header.comments
        self.doubts: list[str] = stored["doubts"]  # about the base's splats, in sentences
        self.extras: list[str] = stored["extras"]  # columns of the base that tiles do not hold
        self.digest: str = stored["digest"]
        self.wrapped, self.photographed = self._wrapped(base, stored["sample"])
        self.wrapped.targets(viewer)  # raises for what no viewer draws
        self.target = self.wrapped.effects(viewer=viewer)  # the sample does not tell whether splats that another near plane shows are in view
        self.backend, self.backend_note = self._backend(base.backend)
        self.asked_steps, self.config = config.steps, config
        self._fit()

    def _wrapped(self, base: Base, sample: Tensor) -> tuple[Wrapped, Scene | None]:
        """Some of the splats with the cameras of all, and the scene that these were read from, if it is given."""
        path, folder, iteration = self.checkpoint.path, self.checkpoint.folder, self.checkpoint.iteration
        origin = Origin(path, self.digest, folder, iteration, self.comments, exposures=read_exposures(folder))
        options, _ = read_options(folder)
        trained = trained_scale(options, self.comments)
        if self.kind is SurfelModel:
            trained = flat_trained(trained)
        model = self.kind(self.base.parameters(sample), trained, origin)
        told: WrapOptions = {"background": COLORS[base.background], "screen_filter": base.screen_filter, "up": base.up}
        wrapped, scene = wrap_unchecked(model, base.cameras, **told)
        return wrapped, None if scene is None or base.cameras is None else replace(scene, points=None)  # which may be millions, and have served

    def _backend(self, name: str) -> tuple[Any, str]:
        splats = self.wrapped.model.gaussians(self.wrapped.any_camera())
        return choose_backend(name, Needs.of(splats, self.base_effects, gradients=True), Needs.of(splats, self.target, gradients=True))

    def _fit(self) -> None:
        """Let the settings have no more steps than a scene of this size can have, and the filter that fits its views, as without tiles."""
        self.config = affordable_for(self.config, self.base.places[:, :3], self.wrapped.cameras, self.target.near_plane)
        self.config = fitting(self.config, self.base_effects, self.views.adapted, self.scale)

    @cached_property
    def base_effects(self) -> Effects:
        """How the base is rendered at its own scale."""
        return self.wrapped.effects()

    @cached_property
    def viewpoints(self) -> Viewpoints:
        """Where views without cameras are: around all splats. Each counts as clear, for nothing here draws the whole scene to look."""
        orbit = orbit_of(self.wrapped.model, self.wrapped.trained, self.base.places[:, :3], lone=not self.wrapped.cameras)
        return Viewpoints(orbit, list)

    @cached_property
    def views(self) -> Views:
        """The views of the whole scene, as without tiles but for captures without cameras: a sample of their splats tells how near views are."""
        cameras = seeing(self.wrapped.cameras, self.base.places[:, :3], self.target.near_plane)
        if not cameras and self.config.views != "orbit":
            warn(orbited(self.checkpoint.path, self.viewpoints.orbit))
        places, near = self.base.places[:, :3], self.base_effects.near_plane
        adapted, validation, note = views_of_run(cameras, self.viewpoints, lambda _: places, near, self.scale, self.config)
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

    def at(self, job: Job, folder: Path) -> TiledScene:
        """The same scene as another job asks for it, for its truths only: its views, and the base that they show. It shares this one's memory."""
        other = copy(self)
        other.scale, other.viewer, other.folder = job.scale, job.viewer, folder
        other.target = self.wrapped.effects(viewer=job.viewer)
        for name in ("views", "sweeps", "used_views"):
            other.__dict__.pop(name, None)
        other.config = job.config()
        other._fit()
        return other

    def for_target(self, parameters: dict[str, Tensor]) -> VanillaModel:
        """A model of some splats, as it is saved for the target; its parameters are leaves that require gradients."""
        return self.kind(parameters, self.wrapped.model.trained.drawn_with(self.target)).copy()

    def base_painter(self, fraction: float) -> Painter:
        """What draws the base in pictures of a fraction of their size."""
        return self.painter(replace(self.base_effects, eps2d=self.base_effects.eps2d * fraction**2))

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
