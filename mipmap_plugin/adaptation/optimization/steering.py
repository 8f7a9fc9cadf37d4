"""Steering by validation: the best state of a run so far, and the rates, which are limited once steps do harm."""

from __future__ import annotations

from dataclasses import dataclass

from mipmap_plugin.adaptation.curve import INVISIBLE_ERROR, decibel
from mipmap_plugin.adaptation.optimization.snapshot import Snapshot
from mipmap_plugin.adaptation.optimization.validation import HARM_DB, TIE_DB, VISIBLE_ERROR
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.models.base import SplatModel

# The rates of a run are multiplied by this after harmful steps.
RATE_REDUCTION = 0.5

# While rates rise, steps do harm that lose this fraction of what the run gained so far, and this many dB at least: real captures gain up to a
# rate of their own, and lose from there on, long before they are worse than at the start; objects gain at all rates. The first steps, of a view
# each, may lose a little to any view they do not show.
LOST_FRACTION, LOST_DB = 0.25, 0.25

# A run with a warm-up begins with its rates multiplied by this.
FIRST_RATE_FACTOR = 1 / 32


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

    def is_stuck(self, progress: float, config: AdaptConfig) -> bool:
        """Whether limited rates hardly gained anything while new views came."""
        tried = config.warm_up > 0 and 0 < config.gathering <= progress
        return tried and self.ceiling < 1 and self._gained_db() <= LOST_DB

    def dare(self) -> None:
        """Stop limiting rates and undoing steps of a run that is stuck, which has little to lose.

        Where few views show each splat, any rate does harm at first, but high ones gain in the end, as they fall.
        """
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
