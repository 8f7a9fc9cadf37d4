"""The points of a tradeoff, what each of them cost and is worth, and the plan of what is measured."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation.measure import Kind

# Ranges do not change any more long before; a slip of the finger would measure for days, and show nothing.
MOST_REPEATS = 1000


@dataclass(frozen=True)
class Spread:
    """Several measurements of one thing."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """The median and the range of several values."""
        return cls(statistics.median(values), min(values), max(values))


NOTHING = Spread(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Point:
    """One way to render a scene at one scale: its cost and its quality."""

    scale: float
    kind: Kind
    name: str
    backend: str
    gaussians: int
    psnr_db: Spread = NOTHING
    adapt_seconds: Spread = NOTHING
    ms_per_frame: Spread | None = None  # None: an intermediate point of a run
    step: int | None = None  # of an intermediate point
    ended_by: str = ""  # of a final point: why the run ended, with all reasons if repeats differ

    @classmethod
    def of(cls, facts: dict[str, Any]) -> Point:
        """The point that `asdict` made these facts of."""
        values: dict[str, Any] = {name: Spread(**value) if isinstance(value, dict) else value for name, value in facts.items()}
        return cls(**values)


@dataclass(frozen=True)
class Plan:
    recipes: Sequence[str] = ("default",)
    steps: Sequence[int | None] = ()  # none: those of each recipe
    backends: Sequence[str] = ("auto",)
    supersampling: Sequence[int] = (2, 4, 8)
    renderers: bool = True  # also measure the first run's model with other settings (`measuring.RENDERERS`)
    repeats: int = 3
    seed: int = 0  # of the first repeat; further repeats have the following seeds
    viewer: str | None = None  # what files are adapted for, and the base is also rendered as

    def __post_init__(self) -> None:
        if not 1 <= self.repeats <= MOST_REPEATS:
            raise SettingsError(f"repeats must be 1 to {MOST_REPEATS}, got {self.repeats}")
        if (least := min(self.supersampling, default=2)) < 2:
            raise SettingsError(f"supersampling must be at least 2, for 2 x 2 samples a pixel, got {least}")
