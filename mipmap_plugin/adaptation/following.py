"""When the field of a moving scene is evaluated anew while splats move: once it matters, for it takes many times as long as drawing them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from mipmap_plugin.adaptation.pixel_size import pixel_size
from mipmap_plugin.camera import Camera
from mipmap_plugin.models.base import SplatModel


class Following:
    """Lets a field be evaluated where splats are, once that is no longer nearly where it was evaluated last, and tells what that takes."""

    reach = 0.0  # how far splats may move in between, px of the target
    moments = 0  # of the views
    rounds = 0.0  # how often splats have moved that far, with the fraction of the last time

    def __init__(self, base: SplatModel | None = None, views: Sequence[Camera] = (), scale: float = 1.0) -> None:
        """`views`: of the base's scale. Without a base, or where it need not be followed, nothing is done."""
        self._whole = 0  # of the rounds
        self._model: Any = None  # what is followed; it shares with the base what is known of the field
        if base is not None and follows(base):
            self._model, pixel = base, float(pixel_size(base.parameters()["means"].detach(), views).median()) / scale
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
        """The number of moments of which it is not known how the field moves the splats as they are."""
        return sum(not self._model.knows(time) for time in self._times)

    @property
    def seconds(self) -> float:
        """Of all evaluations so far."""
        return self._model.spent[0] if self._model is not None else 0.0

    @property
    def evaluation(self) -> float:
        """Seconds of one evaluation of all splats at a moment; 0 before there was one."""
        return self._model.spent[1] if self._model is not None else 0.0


def follows(base: SplatModel) -> bool:
    """Whether a model keeps what its field was evaluated to; one of a third party need not."""
    return base.traits.moves and hasattr(base, "follow")


def keep_rows(model: SplatModel, rows: Tensor) -> None:
    """Tell a model that follows its splats which `rows` [M], ascending, are going to be left."""
    if callable(keep := getattr(model, "keep_rows", None)):
        keep(rows)


def release(model: SplatModel) -> None:
    """Let a field be evaluated exactly where the splats are, from now on."""
    if getattr(model, "held", None) is not None:
        model.held = None  # type: ignore[attr-defined]  # of a model that follows its splats
