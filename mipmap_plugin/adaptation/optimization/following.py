"""When the field of a moving scene is evaluated anew while its splats move: only once it matters, since that takes much longer than drawing them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from torch import Tensor

from mipmap_plugin.adaptation.views.moments import follows
from mipmap_plugin.adaptation.views.pixel_size import target_pixel
from mipmap_plugin.camera import Camera
from mipmap_plugin.models.base import SplatModel


class Following:
    """Has the field evaluated anew once splats have moved too far from where it was evaluated last, and tells what the evaluations take."""

    reach = 0.0  # how far splats may move before the next evaluation, px of the target
    moments = 0  # the number of moments that the views show
    rounds = 0.0  # how many times splats have moved that far so far; the fraction is how far they have come since the last time

    def __init__(self, base: SplatModel | None = None, views: Sequence[Camera] = (), scale: float = 1.0) -> None:
        """`views`: of the base's scale. Without a base, or with one that need not be followed, nothing is done."""
        self._whole = 0  # the whole part of `rounds`
        self._model: Any = None  # the model that is followed; it shares the results of evaluations with the base
        if base is not None and follows(base):
            self._model, pixel = base, target_pixel(base, views, scale)
            self._times, self._distance = {view.time for view in views}, self._model.reach(pixel)
            self.reach, self.moments = self._distance / pixel, len(self._times)

    def __call__(self, student: SplatModel) -> None:
        """Called before each step of a run."""
        if self._model is None:
            return
        self._model = student
        held, moved = self._model.held, self._model.follow(self._distance)
        self._whole += held is not None and self._model.held is not held
        self.rounds = self._whole + moved

    @property
    def unknown(self) -> int:
        """The number of moments at which the field has not been evaluated for the splats as they are."""
        return sum(not self._model.knows(time) for time in self._times)

    @property
    def seconds(self) -> float:
        """Seconds of all evaluations so far."""
        return self._model.spent[0] if self._model is not None else 0.0

    @property
    def evaluation(self) -> float:
        """Seconds of one evaluation of all splats at a moment; 0 before there was one."""
        return self._model.spent[1] if self._model is not None else 0.0


def keep_rows(model: SplatModel, rows: Tensor) -> None:
    """Tell a model that keeps the results of its field that only these `rows` [M], ascending, are going to be left."""
    if follows(model):
        cast(Any, model).keep_motions(rows)


def release(model: SplatModel) -> None:
    """From now on have the field evaluated exactly where the splats are."""
    if getattr(model, "held", None) is not None:
        model.held = None  # type: ignore[attr-defined]  # of a model that follows its splats
