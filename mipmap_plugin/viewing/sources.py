"""What the page can show: the base, adapted files, ladders of levels, the base supersampled, and an adaptation while it runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from mipmap_plugin.adaptation.adapted import Adapted, render_model
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SceneError
from mipmap_plugin.formats.atomic import named
from mipmap_plugin.levels.manifest import MANIFEST, read_manifest
from mipmap_plugin.viewing.screen import inside
from mipmap_plugin.wrap import Wrapped, wrap_model

# Samples per pixel and axis of the supersampled base at most, as many as the default recipe adapts to (`truth_oversampling`).
MOST_SAMPLES = 4


@dataclass(frozen=True)
class Request:
    """One picture of a source."""

    camera: Camera  # whose own `zoom` is that of its lens (`Sampling.with_lens`)
    zoom: float  # how finely the screen samples the scene, relative to the training
    viewer: str | None = None  # as which viewer draws; None: as in its training
    coarse: float = 1.0  # below 1: the camera has fewer pixels than the screen, by this factor on each axis


class Source(Protocol):
    """Something that can be shown."""

    name: str

    def render(self, request: Request) -> Tensor:
        """The picture, [H, W, 3]."""

    def shown(self, zoom: float) -> str:
        """What is shown at this zoom, for people."""

    def splats(self, request: Request) -> tuple[int, int] | None:
        """How many splats lie inside the picture, and how many there are; None where that is not known."""


class File:
    """One checkpoint, as a viewer draws it."""

    def __init__(self, name: str, model: Wrapped) -> None:
        self.name, self._model = name, model
        self._backend, self._read_by = cache(lambda viewer: model.backend(viewer=viewer)[0]), cache(model.read_by)

    def render(self, request: Request) -> Tensor:
        """The picture, [H, W, 3]. Raises SettingsError and BackendUnavailable."""
        effects = coarser(self._model.effects(viewer=request.viewer), request.coarse)
        return render_model(self._read_by(request.viewer), self._backend(request.viewer), request.camera, effects).image

    def shown(self, zoom: float) -> str:
        """The name."""
        return self.name

    @torch.no_grad()
    def splats(self, request: Request) -> tuple[int, int]:
        """How many splats lie inside the picture, and how many there are."""
        model = self._model.model
        means = model.parameters()["means"] if model.traits.same_for_all_views else model.gaussians(request.camera).means
        return int(inside(means, request.camera, self._model.effects().near_plane).sum()), len(means)


class Supersampled(File):
    """The base as it was trained to look, sampled as finely as in its training, whatever the viewer: what adapting aims at."""

    def render(self, request: Request) -> Tensor:
        """The picture, [H, W, 3]: the mean of N x N samples, of which none is finer than four per pixel, or than the training's own."""
        n = 1 if request.coarse < 1 else min(MOST_SAMPLES, max(1, math.ceil(1 / request.zoom)))
        camera = request.camera.resized(request.camera.width * n, request.camera.height * n)
        camera = replace(camera, zoom=camera.zoom / min(1.0, request.zoom))  # a model with levels of detail shows those of its training
        image = self._model.render(camera, request.zoom * request.coarse * n, "scaled").image
        return resize(image.clamp(0, 1), request.camera.size, "box")


class Levels:
    """A ladder of levels, of which each zoom shows the one that is made for it."""

    def __init__(self, name: str, levels: Sequence[tuple[float, File]]) -> None:
        """`levels`: from the finest, each with the zoom down to which it is shown."""
        self.name, self._levels = name, levels

    def at(self, zoom: float) -> File:
        """The level that is shown at a zoom; the coarsest at every smaller one."""
        return next((level for shown_from, level in self._levels if zoom >= shown_from), self._levels[-1][1])

    def render(self, request: Request) -> Tensor:
        """The picture of the level of this zoom, [H, W, 3]."""
        return self.at(request.zoom).render(request)

    def shown(self, zoom: float) -> str:
        """The name of the level."""
        return self.at(zoom).name

    def splats(self, request: Request) -> tuple[int, int]:
        """Those of the level of this zoom."""
        return self.at(request.zoom).splats(request)


def coarser(effects: Effects, factor: float) -> Effects:
    """The effects of a picture with `factor` times as many pixels along each axis that looks like the whole one: splats keep their thickness."""
    if factor == 1:
        return effects
    return replace(effects, eps2d=effects.eps2d * factor**2, settings=effects.settings.finer(factor))


def open_source(path: Path, base: Wrapped, backend: str) -> Source:
    """An adapted file, or the folder of a ladder of levels. Raises CheckpointError, and SceneError for a ladder that is damaged or by distance."""
    if not (path / MANIFEST).is_file():
        return File(named(path).name, _wrapped(path, base, backend))
    name = named(path).name
    return Levels(name, [(least, File(f"{name}, {file}", _wrapped(path / file, base, backend))) for least, file in _levels(path)])


def _levels(folder: Path) -> list[tuple[float, str]]:
    """The zoom down to which each level of a ladder is shown, and its file."""
    by = found = None
    with suppress(KeyError, TypeError, ValueError, AttributeError, OverflowError):
        manifest = read_manifest(folder)
        by = manifest.get("by")
        found = [(float(entry["shown_from"] or 0.0), str(entry["file"])) for entry in manifest["levels"]]
    if by == "distance":
        raise SceneError(f"{folder} holds levels by distance, several of which are in one picture; give a file of it, or make it with --by zoom")
    if not found:
        raise SceneError(f"{folder / MANIFEST}: lists no levels, or is damaged; make the ladder again with `mipmap-plugin levels`")
    return found


def of_adapted(name: str, adapted: Adapted, base: Wrapped) -> File:
    """What an adaptation returned."""
    trained = replace(adapted.model.trained, background=base.trained.background, near_plane=base.trained.near_plane)
    return File(name, Wrapped(adapted.model, base.cameras, adapted.backend.name, trained))


def _wrapped(path: Path, base: Wrapped, backend: str) -> Wrapped:
    return wrap_model(path, cameras=base.cameras, backend=backend, background=base.background)
