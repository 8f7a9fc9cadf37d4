"""What was gained by when: the clock, the curve, and the reasons to stop."""

from __future__ import annotations

import math
import time

import torch
from pydantic import BaseModel, ConfigDict

from mipmap_plugin.config import AdaptConfig


class CurvePoint(BaseModel):
    """One point of accuracy against time."""

    model_config = ConfigDict(frozen=True)

    step: int
    seconds: float  # of adapting, what came before the first step included; an observer's measuring is not billed
    psnr_db: float | None  # against the pseudo truth, over the views since the last point; None where no step was taken since
    validation_db: float  # of the state that the run goes on with, on views that nothing is adapted to
    gaussians: int
    taken_back: bool = False  # the steps since the best state had done harm, and are undone


class Stopwatch:
    """Seconds spent inside `with`, so that measuring quality is not billed as adapting.

    With a `device` its work is waited for at both ends; without, whoever uses the watch waits where it is right to.
    """

    def __init__(self, device: torch.device | None = None, seconds: float = 0.0) -> None:
        self.seconds, self._device = seconds, device
        self._start: float | None = None

    def __enter__(self) -> Stopwatch:
        self._start = self._now()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds, self._start = self.read(), None

    def read(self) -> float:
        """Seconds until now, inside `with` too."""
        return self.seconds if self._start is None else self.seconds + self._now() - self._start

    def _now(self) -> float:
        if self._device is not None and self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter()


def progress(step: int, seconds: float, config: AdaptConfig) -> float:
    """0..1: how much of its steps or of its time budget a run has used, whichever is more."""
    return min(1.0, max(step / max(1, config.steps), seconds / (config.time_budget_s or math.inf)))


def decibel(mean_square: float) -> float:
    """PSNR of images in 0..1."""
    return -10 * math.log10(max(mean_square, 1e-12))  # 120 dB: beyond single precision


def reason_to_stop(curve: list[CurvePoint], seconds: float, config: AdaptConfig) -> str | None:
    """Why adapting ends before its last step: the budget is spent, the target reached, or the knee passed."""
    if config.time_budget_s is not None and seconds >= config.time_budget_s:
        return f"time budget of {config.time_budget_s:g} s"
    found = [point.psnr_db for point in curve if point.psnr_db is not None]
    if config.target_db is not None and found and found[-1] >= config.target_db:
        return f"target of {config.target_db:g} dB against the pseudo truth"
    waited = config.patience is not None and len(found) > config.patience
    if waited and max(found[-config.patience :]) < max(found[: -config.patience]) + config.min_gain_db:  # type: ignore[operator]
        return f"knee: {config.patience} checks in a row gained less than {config.min_gain_db:g} dB"
    return None
