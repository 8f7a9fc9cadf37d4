"""A zoom-in for a renderer that draws otherwise than the training did, in two stages.

Its way to draw is learned at the base's own scale, where an image has 1/s² of the pixels of one at x s; the zoom-in then starts from this
conversion, in closed form. Both compare images of the base's size, so that nothing is lost. At x2, a board of stripes for spark has 24 dB
without and 32 with it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.optimization.ending import End
from mipmap_plugin.adaptation.optimization.state_file import StateFile
from mipmap_plugin.adaptation.report import Report
from mipmap_plugin.adaptation.request import AdaptationRequest, Observer
from mipmap_plugin.adaptation.session import Session
from mipmap_plugin.adaptation.start.problem import FinerLevel
from mipmap_plugin.adaptation.target.photographs import Photographs
from mipmap_plugin.adaptation.views.for_validation import count_of_views
from mipmap_plugin.adaptation.views.remarks import orbited
from mipmap_plugin.adaptation.views.shown import seeing
from mipmap_plugin.adaptation.warn import warn
from mipmap_plugin.camera import ONE_PIXEL, Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import SettingsError, plural
from mipmap_plugin.models.adapted_scale import refuse_adapted
from mipmap_plugin.models.contract import refuse_broken
from mipmap_plugin.models.places import conversion_state
from mipmap_plugin.recipes import recipe as make_config

# What the conversion is called in the report.
NAME = "the conversion at x1"

# The fraction of a time budget that each stage may take, whatever the other one takes, so that an interrupted zoom-in can be resumed.
SHARE = 0.5


def conversion(config: AdaptConfig, base: Effects, targets: Collection[Effects], scale: float) -> AdaptConfig | None:
    """The settings of the conversion before a zoom-in with `config`; None where there is none. `base`: how the base is rendered.

    It has the views of the zoom-in, and those that are kept for validation are adapted to in neither stage.
    A file for several viewers has none: at x1, where their filters differ most, it would learn a compromise that a zoom-in does not need.
    """
    steps = min(config.conversion_steps, config.steps)
    if scale <= 1 or not steps or len(targets) > 1 or base in targets:
        return None
    same = {name: getattr(config, name) for name in ("seed", "views", "extra_views", "farthest", "most_splats")}
    changes = {"steps": steps, "most_steps": None, "time_budget_s": _half(config), "validation_views": count_of_views(config)}
    return make_config(config.recipe, 1.0, **same).model_copy(update=changes)


@dataclass(frozen=True, eq=False)
class Stages:
    """A request with what both stages have in common."""

    request: AdaptationRequest
    cameras: list[Camera]
    photographs: Photographs | None
    resume: Path | None
    observe: Observer | None

    def adapt(self, scale: float, config: AdaptConfig, first: AdaptConfig | None) -> Adapted:
        """Adapt to `scale`; `first`: the settings of a conversion before. Raises as `Session.run` does."""
        base = self.request.images.model
        refuse_adapted(base.source)
        if not self.cameras and config.views != "orbit":
            warn(orbited(base.source, self.request.viewpoints.orbit))
        refuse_broken(base, next(iter(self.cameras), ONE_PIXEL), steps=config.steps > 0)
        near = self.request.images.effects.near_plane
        # The splats of a moving scene are elsewhere at other moments.
        cameras = self.cameras if base.traits.moves else seeing(self.cameras, base.parameters()["means"], near)
        if first is None:
            return Session(self.request, scale, config, cameras, self.photographs).run(self.resume, self.observe)
        return self._in_two(scale, config, first, cameras)

    def _in_two(self, scale: float, config: AdaptConfig, first: AdaptConfig, cameras: list[Camera]) -> Adapted:
        """Convert the base with the settings `first`, and adapt what that returns to `scale`."""
        session = Session(replace(self.request, zoom_in=scale), 1.0, first, cameras, None)
        converted = replace(session.run(self.resume and conversion_state(self.resume), self.observe), judge=None)  # which nobody saves
        stopped = session.ended is End.OBSERVER
        del session  # with the truths of its views
        half = config.model_copy(update={"time_budget_s": _half(config)} | ({"steps": 0} if stopped else {}))
        finer = FinerLevel(converted.model, 1.0, NAME, converts=True, learned=learned(converted.report))
        request = replace(self.request, finer=finer, budget_share=SHARE)
        with _kept_if_interrupted(converted.states):
            adapted = Session(request, scale, half, cameras, self.photographs).run(self.resume, self._further(converted.report))
        settings = {"time_budget_s": config.time_budget_s} | ({"steps": config.steps} if stopped else {})
        report = adapted.report.model_copy(update={"settings": adapted.report.settings.model_copy(update=settings)})
        return replace(adapted, report=_joined(converted.report, report, stopped), states=[*converted.states, *adapted.states])

    def _further(self, first: Report) -> Observer | None:
        """The observer of the second stage, whose steps and seconds are counted on from those of the first."""
        observe, steps, spent = self.observe, first.curve[-1].step, first.seconds["total"]
        if observe is None:
            return None
        return lambda step, seconds, render: step > 0 and observe(step + steps, seconds + spent, render)


@contextmanager
def _kept_if_interrupted(states: Sequence[StateFile]) -> Iterator[None]:
    """Leave the states to the next run, should this one be interrupted, or be refused, as by a state of another version; remove them should it
    fail, as no other run leaves one then."""
    try:
        yield
    except (KeyboardInterrupt, SettingsError):
        for state in states:
            state.release()
        raise
    except Exception:
        for state in states:
            state.remove()
        raise


def learned(report: Report) -> bool:
    """Whether steps of a conversion have more dB than the base and the start, from which they were taken."""
    base_and_start = list(report.validation.values())[:2]
    return (report.psnr_after() or 0.0) > max(base_and_start, default=math.inf)


def _half(config: AdaptConfig) -> float | None:
    """The seconds that each stage may take."""
    return config.time_budget_s and SHARE * config.time_budget_s


def _joined(first: Report, second: Report, stopped: bool) -> Report:
    """The second stage's report, which tells of the first one too. `stopped`: the observer ended that."""
    spent, steps = first.seconds["total"], plural(first.curve[-1].step, "step")
    seconds = {"conversion": spent, **second.seconds, "total": second.seconds["total"] + spent}
    curve = [point.model_copy(update={"seconds": point.seconds + spent}) for point in second.curve]
    told = f"converted at x1 before, {first.gain()}, in {steps}{f', ended by {End.OBSERVER.value}' if stopped else ''}"
    peaks = [peak for peak in (first.peak_memory_mib, second.peak_memory_mib) if peak is not None]
    notes = [*dict.fromkeys([*first.notes, *second.notes]), told]
    changes = {"seconds": seconds, "curve": curve, "notes": notes, "peak_memory_mib": max(peaks, default=None)}
    return second.model_copy(update=changes)
