"""Validation: views that nothing is adapted to show how a run is going, and which of its states to return, never one worse than the base.

Half of them steer the run: it is compared with the base on them at every check, harmful steps are undone, and the best state is kept.
The other half is used once, at the end, to choose among the base as it is, the start, the best state and the last.
Where there is a single view, it does both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean
from typing import NamedTuple

import torch
from torch import Tensor

from mipmap_plugin.adaptation.curve import INVISIBLE_ERROR, decibel
from mipmap_plugin.adaptation.parallel import max_threads, together
from mipmap_plugin.adaptation.renderers import Renderer
from mipmap_plugin.adaptation.target.resize import difference_from
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.process.threads import side_by_side

# A zoom-in is validated against the base's own image, whatever it is adapted to.
COMPARED_WITH_BASE = {"compare_at": "base", "quantize_truth": False}

# dB: a state that is worse than the start by more than this is undone. Rounding and the choice of views make smaller differences.
HARM_DB = 0.1

# The square of two steps of 8 bits, 42 dB, below which differences are hardly seen. It is added to the errors that states are compared by: otherwise
# views of a plain sky that fall from 90 dB to 50 would outweigh others that rise from 20 to 30. With one step (48 dB) an object among such views
# has 1 dB less, for their small losses still take its steps back.
VISIBLE_ERROR = (2 / 255) ** 2

# dB: states whose PSNR differs by less count as equal; of these the later is preferred, because it has learned more.
TIE_DB = 0.01


class Quality(NamedTuple):
    """How good a state is on some views, in dB."""

    visible: float  # as far as differences are visible: states are compared by it
    psnr: float  # what is told

    @classmethod
    def of(cls, errors: Sequence[Sequence[float]]) -> Quality:
        """That of a state with these mean square errors of each view, per viewer, of which the worst viewer counts most.

        The worst viewer alone would be too strict, as it may fall a little while all others improve; the mean PSNR would hide it.
        """
        return cls(*(decibel(fmean(10 ** (-mean(each) / 10) for each in errors)) for mean in (_visible_db, mean_db)))


class Choice(NamedTuple):
    """The state that is returned, and how good each state is, by its name."""

    state: str
    psnrs: dict[str, float]  # dB in the worst viewer
    by_view: dict[str, list[float]]  # dB of each view, as far as differences are visible
    by_viewer: dict[str, list[float]]  # dB in each viewer, likewise


@dataclass(frozen=True)
class Validation:
    """Views of the base scale, the truth of each, and the comparison of a model with it."""

    steering: Sequence[Camera]
    choosing: Sequence[Camera]
    scale: float
    truth: Callable[[Camera], Tensor]  # a view of the base scale -> the image to compare with
    renders: Sequence[Callable[[Gaussians, Camera], Tensor]]  # splats and a camera of the new scale -> image; of each viewer they are adapted for
    resize: str  # the filter that brings an image to the truth's size

    def viewer_psnrs(self, model: SplatModel, views: Sequence[Camera]) -> list[float]:
        """The mean PSNR (dB) over views, per viewer, of images clamped as a display does, each at most 54 (INVISIBLE_ERROR); 0 without views."""
        return [mean_db(errors) for errors in self._errors(model, views)]

    @torch.no_grad()
    def _errors(self, model: SplatModel, views: Sequence[Camera]) -> list[list[float]]:
        """The mean square error of each view, per viewer."""
        if not views:
            return [[] for _ in self.renders]
        shared = model.gaussians(views[0]) if model.traits.same_for_all_views else None
        cameras = [view.zoomed(self.scale) for view in views]
        threads = max_threads(model.parameters()["means"], cameras[0])

        def error(draw: Callable[[Camera], Tensor], number: int) -> Tensor:
            image, truth = draw(cameras[number]).clamp(0, 1), self.truth(views[number]).clamp(0, 1)
            return difference_from(truth, image, self.resize).square().mean()

        draws = [_drawing(render, model, shared, cameras) for render in self.renders]
        errors = [list(side_by_side(partial(error, draw), range(len(views)), threads)) for draw in draws]
        return [torch.stack(each).tolist() for each in errors]  # a GPU is waited for once, and not for each view

    def kept(self) -> Validation | None:
        """This validation with the choosing views alone and their truths in memory, to judge files after the run; None if there are no such views."""
        if not self.choosing:
            return None
        truths = {view: self.truth(view) for view in self.choosing}
        return replace(self, steering=[], truth=truths.__getitem__)

    def steer(self, model: SplatModel) -> float:
        """The visible quality (dB) on the steering views."""
        return self.quality(model).visible

    def quality(self, model: SplatModel) -> Quality:
        """The quality on the steering views."""
        return Quality.of(self._errors(model, self.steering))

    def choose(self, states: dict[str, SplatModel], allowed: Collection[str] | None = None) -> Choice:
        """The state of the best visible quality, of those that are `allowed`.

        Of states that are equal the last, but none that is worse than the first of `states`, which is what went in.
        """
        errors = {name: self._errors(model, self.choosing) for name, model in states.items()}
        by_viewer = {name: [*map(_visible_db, each)] for name, each in errors.items()}
        quality = {name: min(each) for name, each in by_viewer.items()}
        chosen = last_of_best({name: quality[name] for name in states if allowed is None or name in allowed}, next(iter(states)))
        by_view = {name: [_visible_db([fmean(one)]) for one in zip(*each, strict=True)] for name, each in errors.items()}
        return Choice(chosen, {name: min(map(mean_db, each)) for name, each in errors.items()}, by_view, by_viewer)


def _drawing(
    render: Callable[[Gaussians, Camera], Tensor], model: SplatModel, shared: Gaussians | None, cameras: Sequence[Camera]
) -> Callable[[Camera], Tensor]:
    """A function that draws a model for any of `cameras`. `shared`: the splats, if they are the same for all cameras."""
    if shared is None:
        return lambda camera: render(model.gaussians(camera), camera)
    if not isinstance(render, Renderer):
        return partial(render, shared)
    render_views = getattr(render.backend, "render_views", None)
    if render_views is None or render.effects.settings.by_view or together(shared.means, cameras) < len(cameras):
        return render.of(shared)
    drawn = dict(zip(cameras, render_views(shared, [(camera, render.effects) for camera in cameras]), strict=True))
    return lambda camera: drawn[camera].image


def last_of_best(visible: Mapping[str, float], first: str) -> str:
    """The last of the states that are as good as the best by these visible dB, but none that is worse than the `first`, which is what went in."""
    least = max(max(visible.values()) - TIE_DB, visible.get(first, -math.inf))
    return [name for name, db in visible.items() if db >= least][-1]


def mean_db(errors: Sequence[float]) -> float:
    """The mean PSNR (dB) over views of these mean square errors; what is invisible is not told."""
    return fmean(decibel(max(error, INVISIBLE_ERROR)) for error in errors) if errors else 0.0


def _visible_db(errors: Sequence[float]) -> float:
    """The mean PSNR (dB) over views as far as differences are visible; for good views it hardly changes."""
    return fmean(decibel(error + VISIBLE_ERROR) for error in errors) if errors else 0.0


def psnr_per_viewer(validation: Validation, backend: Backend, targets: Mapping[str, Effects], model: SplatModel) -> dict[str, float]:
    """PSNR (dB) of a model in each viewer on the views that choose among states, where it is made for several; {} for one."""
    if len(targets) == 1:
        return {}
    renders = [Renderer(backend, target) for target in targets.values()]
    psnrs = replace(validation, renders=renders).viewer_psnrs(model, validation.choosing)
    return dict(zip(targets, psnrs, strict=True))


def psnr_as_trained(validation: Validation, backend: Backend, targets: Mapping[str, Effects], base: SplatModel, effects: Effects) -> float | None:
    """PSNR (dB) of the base on the same views as its training draws it (`effects`).

    None at x1, where that is the truth itself, and where the file is drawn so too, so that this is the base as it is.
    """
    if validation.scale == 1 or not validation.choosing or effects in targets.values():
        return None
    return replace(validation, renders=[Renderer(backend, effects)]).viewer_psnrs(base, validation.choosing)[0]


def no_validation(truth: Callable[[Camera], Tensor], render: Callable[[Gaussians, Camera], Tensor]) -> Validation:
    """Validation without views, for a training, in which no step is undone."""
    return Validation([], [], 1.0, truth, [render], "area")
