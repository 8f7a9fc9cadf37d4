"""Validation: views that nothing is adapted to show how a run is going, and which of its states to return, never one worse than the base.

Half of them steer the run: it is compared with the base on them at every check, harmful steps are undone, and the best state is kept.
The other half is used once, at the end, to choose among the base as it is, the start, the best state and the last.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean
from typing import NamedTuple

import torch
from torch import Tensor

from mipmap_plugin.adaptation.curve import decibel
from mipmap_plugin.adaptation.optimization.losses import INVISIBLE_ERROR
from mipmap_plugin.adaptation.optimization.snapshot import Snapshot
from mipmap_plugin.adaptation.parallel import max_threads, together
from mipmap_plugin.adaptation.renderers import Renderer
from mipmap_plugin.adaptation.target.resize import difference_from
from mipmap_plugin.adaptation.viewpoints import Viewpoints
from mipmap_plugin.adaptation.views import choose_views
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.process.threads import side_by_side
from mipmap_plugin.scenes.trajectories import jittered, with_company

# At most one in this many of the given cameras is kept for validation, where the policy leaves the choice of views to us.
VALIDATION_EVERY = 16

# One validation view per this many rendered views, so that validation takes at most a tenth of the time; but at least `MIN_VIEWS`.
RENDERS_PER_VIEW = 25
MIN_VIEWS = 4

# At least as many where no step is taken: nothing makes up for a start that is chosen wrongly. With 4, of which one or two see little but the sky,
# an object is left as it is (at x1/4 24.0 dB in place of 28.1, at x2 38.7 in place of 43.1), and 8 take 0.1 to 0.8 s more.
MIN_VIEWS_OF_START = 8

# px: validation uses at most this much of a view along each side, so that large images stay cheap.
WINDOW = 768

# Of a number of pixels that is a whole one, as of a third.
ROUNDING = 1e-6

# Added to the seed for the random views of validation, so that they differ from the views that are adapted to.
SEED_OFFSET = 7919

# dB: a state that is worse than the start by more than this is undone. Rounding and the choice of views make smaller differences.
HARM_DB = 0.1

# The square of two steps of 8 bits, 42 dB, below which differences are hardly seen. It is added to the errors that states are compared by: otherwise
# views of a plain sky that fall from 90 dB to 50 would outweigh others that rise from 20 to 30. With one step (48 dB) an object among such views
# has 1 dB less, for their small losses still take its steps back.
VISIBLE_ERROR = (2 / 255) ** 2

# dB: states whose PSNR differs by less count as equal; of these the later is preferred, because it has learned more.
TIE_DB = 0.01

# The rates of a run are multiplied by this after harmful steps.
RATE_REDUCTION = 0.5

# While rates rise, steps do harm that lose this fraction of what the run gained so far, and this many dB at least: real captures gain up to a
# rate of their own, and lose from there on, long before they are worse than at the start; objects gain at all rates. The first steps, of a view
# each, may lose a little to any view they do not show.
LOST_FRACTION, LOST_DB = 0.25, 0.25

# A run with a warm-up begins with its rates multiplied by this.
FIRST_RATE_FACTOR = 1 / 32


class Quality(NamedTuple):
    """How good a state is on some views, in dB."""

    visible: float  # as far as differences are visible: states are compared by it
    psnr: float  # what is told


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
        """The quality on the steering views, of the mean square error over viewers, in which the worst viewer counts most.

        The worst viewer alone would be too strict, as it may fall a little while all others improve; the mean PSNR would hide it.
        """
        errors = self._errors(model, self.steering)
        return Quality(*(decibel(fmean(10 ** (-mean(each) / 10) for each in errors)) for mean in (_visible_db, mean_db)))

    def choose(self, states: dict[str, SplatModel], allowed: Collection[str] | None = None) -> tuple[str, dict[str, float], dict[str, list[float]]]:
        """The state of the best visible quality, of those that are `allowed`, each state's PSNR in its worst viewer, and its visible dB of each view.

        Of states that are equal the last, but none that is worse than the first of `states`, which is what went in.
        """
        errors = {name: self._errors(model, self.choosing) for name, model in states.items()}
        quality = {name: min(map(_visible_db, each)) for name, each in errors.items()}
        among = [name for name in states if allowed is None or name in allowed]
        best, first = max(quality[name] for name in among), next(iter(states))
        least = max(best - TIE_DB, quality[first]) if first in among else best - TIE_DB
        chosen = [name for name in among if quality[name] >= least][-1]
        by_view = {name: [_visible_db([fmean(one)]) for one in zip(*each, strict=True)] for name, each in errors.items()}
        return chosen, {name: min(map(mean_db, each)) for name, each in errors.items()}, by_view


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


def mean_db(errors: Sequence[float]) -> float:
    """The mean PSNR (dB) over views of these mean square errors; what is invisible is not told."""
    return fmean(decibel(max(error, INVISIBLE_ERROR)) for error in errors) if errors else 0.0


def _visible_db(errors: Sequence[float]) -> float:
    """The mean PSNR (dB) over views as far as differences are visible; for good views it hardly changes."""
    return fmean(decibel(error + VISIBLE_ERROR) for error in errors) if errors else 0.0


def no_validation(truth: Callable[[Camera], Tensor], render: Callable[[Gaussians, Camera], Tensor]) -> Validation:
    """Validation without views, for a training, in which no step is undone."""
    return Validation([], [], 1.0, truth, [render], "area")


def split_validation(
    cameras: Sequence[Camera], views: Sequence[Camera], viewpoints: Viewpoints, scale: float, config: AdaptConfig
) -> tuple[list[Camera], list[Camera]]:
    """Return the views to adapt to, out of `views`, and the views for validation.

    For validation: some of the given cameras, where a policy chooses among enough of them, and random views from the region that they
    span; without cameras, the views of another orbit. Of large images only the middle is used; there are no validation views if one
    pixel of the base is larger than that. `viewpoints`: as of `choose_views`.
    """
    if scale > WINDOW:
        return list(views), []
    adapted, validation = _validation_views(cameras, views, viewpoints, config)
    size = _window_side(scale)
    return adapted, [view.window(size, size) for view in validation]


def _window_side(scale: float) -> int:
    """px of the base: at a zoom-out those of whole pixels of the new scale, which a filter of whole blocks (`box`) needs."""
    if scale >= 1:
        return round(WINDOW / scale)
    return min(WINDOW, round(max(1, math.floor(WINDOW * scale + ROUNDING)) / scale))


def count_of_views(config: AdaptConfig) -> int:
    """How many views there are for validation."""
    fewest = MIN_VIEWS if config.steps else MIN_VIEWS_OF_START
    return min(config.validation_views, max(fewest, config.steps * config.views_per_step // RENDERS_PER_VIEW))


def _validation_views(
    cameras: Sequence[Camera], views: Sequence[Camera], viewpoints: Viewpoints, config: AdaptConfig
) -> tuple[list[Camera], list[Camera]]:
    """`split_validation` with whole images. Random views come first in each pair, so that they steer and kept cameras choose."""
    count = count_of_views(config)
    generator = torch.Generator().manual_seed(config.seed + SEED_OFFSET)
    if config.views == "orbit" or not cameras:
        changes = {"views": "orbit", "extra_views": count, "seed": config.seed + SEED_OFFSET}
        validation, _ = choose_views(cameras, viewpoints, config.model_copy(update=changes))
        return list(views), validation
    given = set(cameras)
    originals = [view for view in views if view in given]
    kept: list[Camera] = []
    if config.views in ("train", "jittered"):
        kept = evenly(originals[VALIDATION_EVERY // 2 :], min(count // 2, len(originals) // VALIDATION_EVERY))
    adapted = [view for view in views if view not in kept]
    known = with_company(originals or list(views), viewpoints.orbit)
    random = jittered(known, count - len(kept), generator, spread=False)
    return adapted, [view for pair in zip(random, kept, strict=False) for view in pair] + random[len(kept) :]


def warmed_up(step: int, config: AdaptConfig) -> float:
    """The factor of every rate after `step` steps as far as nothing does harm: it rises geometrically to 1 during the warm-up."""
    warm_up = config.warm_up_steps
    return FIRST_RATE_FACTOR ** (1 - step / warm_up) if step < warm_up else 1.0


@dataclass
class Steering:
    """The progress of a run on the steering views: its best state, and a limit on its rates."""

    start_db: float
    best_db: float
    best: Snapshot
    best_step: int = 0
    best_factor: float = 1.0  # the rate factor of the step that led there
    ceiling: float = 1.0  # upper limit of the rate factor, after larger rates did harm
    rises: bool = False  # whether the ceiling rises again with what is gained
    bold: bool = False  # whether steps may do harm on the way

    @classmethod
    def begin(cls, student: SplatModel, psnr: float) -> Steering:
        """The steering of a run that begins with `student`, which has this PSNR (dB) on the steering views."""
        return cls(psnr, psnr, Snapshot.of(student))

    def rate_factor(self, step: int, config: AdaptConfig) -> float:
        """The factor of every rate after `step` steps: it rises geometrically to 1 during the warm-up, and is at most the ceiling."""
        return min(warmed_up(step, config), self.ceiling)

    def is_rising(self, step: int, config: AdaptConfig) -> bool:
        """Whether the rates of the step before this one were still being tried: in the warm-up, and under a ceiling that rises."""
        return step <= config.warm_up_steps or self.rises

    def is_harmful(self, psnr: float, *, rising: bool = False) -> bool:
        """Whether a state with this PSNR is worse than the start or, while rates are `rising`, has lost much of what was gained."""
        if self.bold:
            return False
        if rising:
            return psnr < self.best_db - max(LOST_DB, LOST_FRACTION * (self.best_db - self.start_db))
        return psnr < self.start_db - HARM_DB

    def reduce_rates(self, rate_factor: float, *, rising: bool = False) -> None:
        """Limit the rates to a fraction of `rate_factor`, which did harm; while they were `rising`, to those that led to the best state.

        The first and lowest rates may do harm before anything is gained, which tells little of those to come: this limit rises again.
        """
        self.rises = rising and self.best_step == 0
        lower = rising and self.best_step > 0 and self.best_factor < rate_factor
        self.ceiling = self.best_factor if lower else RATE_REDUCTION * rate_factor

    def dare(self, progress: float, config: AdaptConfig) -> None:
        """Stop limiting rates and undoing steps if limited rates hardly gained anything while new views came: there is little to lose.

        Where few views show each splat, any rate does harm at first, but high ones gain in the end, as they fall.
        """
        if config.warm_up and config.gathering and self.ceiling < 1 and progress >= config.gathering and self._gained_db() <= LOST_DB:
            self.ceiling, self.bold = 1.0, True

    def _gained_db(self) -> float:
        """The gain of the best state over the start, dB, by the whole error: the visible error of a good start hardly changes."""
        start, best = (max(10 ** (-db / 10) - VISIBLE_ERROR, INVISIBLE_ERROR) for db in (self.start_db, self.best_db))
        return decibel(best) - decibel(start)

    def update_best(self, psnr: float, step: int, student: SplatModel, rows_changed: bool = False, rate_factor: float = 1.0) -> None:
        """Keep the student's state, to which steps of `rate_factor` led, as the best one, unless it is worse."""
        if self.rises and psnr > self.best_db + TIE_DB:
            self.ceiling = min(1.0, self.ceiling / RATE_REDUCTION)
        if psnr >= self.best_db - TIE_DB:
            self.best_db, self.best_step, self.best_factor = max(psnr, self.best_db), step, rate_factor
            self.best = self.best.renewed(student, rows_changed)
