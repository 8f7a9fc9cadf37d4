"""Accuracy against time during a run: the clock, and the points of the curve."""

from __future__ import annotations

import math

import torch
from pydantic import BaseModel, ConfigDict

from mipmap_plugin.process.clock import now

# The square of half a step of an 8-bit image: smaller mean square differences are invisible on a display, and hardly count.
INVISIBLE_ERROR = (0.5 / 255) ** 2


class CurvePoint(BaseModel):
    """One point of accuracy against time.

    Attributes:
        step: Steps before it.
        seconds: Of adapting, including the time before the first step, excluding the time that an observer takes.
        psnr_db: PSNR against the pseudo truth, over the views since the last point; None where no step was taken since.
        validation_db: PSNR of the state that the run continues from, on views that nothing is adapted to.
        gaussians: How many splats there are.
        taken_back: The steps since the best state did harm, and were undone.
    """

    model_config = ConfigDict(frozen=True)

    step: int
    seconds: float
    psnr_db: float | None = None
    validation_db: float
    gaussians: int
    taken_back: bool = False


class Stopwatch:
    """Counts the seconds spent inside `with`, so that measuring quality does not count as adapting.

    With a `device`, the watch synchronizes with it at both ends; without, its user has to synchronize where needed.
    """

    def __init__(self, device: torch.device | None = None, seconds: float = 0.0) -> None:
        self.seconds, self._device = seconds, device
        self._start: float | None = None

    def __enter__(self) -> Stopwatch:
        self._start = now(self._device)
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds, self._start = self.read(), None

    def read(self) -> float:
        """Return the seconds so far, also inside `with`."""
        return self.seconds if self._start is None else self.seconds + now(self._device) - self._start


def decibel(mean_square: float) -> float:
    """PSNR in dB for the mean square error of images in 0..1."""
    return -10 * math.log10(max(mean_square, 1e-12))  # 120 dB: beyond single precision


def psnr_as_shown(image: torch.Tensor, truth: torch.Tensor) -> float:
    """PSNR (dB) of two images, clamped to 0..1 as a display does. On their own device, and quicker than the metric of evaluations."""
    return decibel(float((image.clamp(0, 1) - truth.clamp(0, 1)).square().mean()))
