"""A zoom-in for a renderer that draws otherwise than the training did, in two stages.

Its way to draw is learned at the base's own scale, where an image costs 1/s² of one at x s; the zoom-in then starts from this conversion, in
closed form. Both compare images of the base's size, so that nothing is lost. At x2, a board of stripes for spark has 24 dB without and 32 with it.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.optimization.loop import STOPPED
from mipmap_plugin.adaptation.optimization.validation import count_of_views
from mipmap_plugin.adaptation.report import Report
from mipmap_plugin.adaptation.session import AdaptationRequest, Observer, Session
from mipmap_plugin.adaptation.start.candidates import FinerLevel
from mipmap_plugin.adaptation.target.photographs import Photographs
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.recipes import recipe as make_config

# What the conversion is called in the report, and what is appended to the name of the state's file for its own.
NAME, STATE = "the conversion at x1", ".x1"

# The fraction of a time budget that each stage may take. It does not depend on the clock, so that an interrupted zoom-in can be resumed.
SHARE = 0.5


def conversion(config: AdaptConfig, base: Effects, targets: Collection[Effects], scale: float) -> AdaptConfig | None:
    """The settings of the conversion before a zoom-in with `config`; None where there is none. `base`: how the base is rendered.

    Its views are those of the zoom-in, whose images are drawn once, and so are its views for validation, to which nothing is adapted in either.
    A file for several viewers has none: at x1, where their filters differ most, it would learn a compromise that a zoom-in does not need.
    """
    steps = min(config.conversion_steps, config.steps)
    if scale <= 1 or not steps or len(targets) > 1 or base in targets:
        return None
    same = {name: getattr(config, name) for name in ("seed", "views", "extra_views", "most_splats")}
    changes = {"steps": steps, "time_budget_s": _half(config), "validation_views": count_of_views(config)}
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
        if first is None:
            return Session(self.request, scale, config, self.cameras, self.photographs).run(self.resume, self.observe)
        session = Session(self.request, 1.0, first, self.cameras, None)
        session.keeps_state = True
        converted = session.run(self.resume and self.resume.with_name(self.resume.name + STATE), self.observe)
        request = replace(self.request, finer=FinerLevel(converted.model, 1.0, NAME))
        stopped = converted.report.ended_by.startswith(STOPPED)
        half = config.model_copy(update={"time_budget_s": _half(config), "steps": 0 if stopped else config.steps})
        adapted = Session(request, scale, half, self.cameras, self.photographs).run(self.resume, self.observe)
        if converted.state is not None:
            converted.state.remove()
        settings = adapted.report.settings.model_copy(update={"time_budget_s": config.time_budget_s, "steps": config.steps})
        return replace(adapted, report=_joined(converted.report, adapted.report.model_copy(update={"settings": settings})))


def _half(config: AdaptConfig) -> float | None:
    """The seconds that each stage may take."""
    return config.time_budget_s and SHARE * config.time_budget_s


def _joined(first: Report, second: Report) -> Report:
    """The second stage's report, which tells of the first one too."""
    spent = first.seconds["total"]
    seconds = {"conversion": spent, **second.seconds, "total": second.seconds["total"] + spent}
    curve = [point.model_copy(update={"seconds": point.seconds + spent}) for point in second.curve]
    notes = [*second.notes, f"converted at x1 before, {first.gain()}, ended by {first.ended_by}"]
    return second.model_copy(update={"seconds": seconds, "curve": curve, "notes": notes})
