"""What the truths and the checks of a run have cost so far."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.process import threads
from mipmap_plugin.process.clock import now

Result = TypeVar("Result")


@dataclass
class Costs:
    """Seconds, by what they were spent on. Work in parallel counts as the time that passed; that of a GPU until it is done."""

    truths: dict[Camera, float] = field(default_factory=dict)  # of making the truth of each view
    checks: list[float] = field(default_factory=list)  # of each comparison with the validation views
    earlier: tuple[float, float] = (0.0, 0.0)  # of truths and of checks, in the processes that a run was interrupted in
    motion: Callable[[], float] = lambda: 0.0  # of evaluating the field of a moving scene, so far; not part of the others
    device: torch.device | None = None  # that does the work

    def truth(self, view: Camera, make: Callable[[Camera], Tensor]) -> Tensor:
        """Return the truth of a view; the first time, note how long it took."""
        if view in self.truths:
            return make(view)
        began = self._now()
        image = make(view)
        self.truths.setdefault(view, (self._now() - began) / threads.side_by_side_now())
        return image

    def prepare(self, views: Sequence[Camera], make: Callable[[Sequence[Camera]], object]) -> None:
        """Make the truths of `views`, which have none yet, together; note how long that took."""
        began = self._now()
        make(views)
        each = (self._now() - began) / len(views)
        for view in views:
            self.truths.setdefault(view, each)

    def check(self, validate: Callable[[], Result]) -> Result:
        """Return the result of a validation, and note how long it took."""
        began = self._now()
        result = validate()
        self.checks.append(self._now() - began)
        return result

    def sums(self) -> tuple[float, float]:
        """The seconds of all truths, and of all checks, of the whole run."""
        return self.earlier[0] + sum(self.truths.values()), self.earlier[1] + sum(self.checks)

    def seconds(self) -> float:
        """All that is noted."""
        return sum(self.sums())

    def _now(self) -> float:
        return now(self.device) - self.motion()
