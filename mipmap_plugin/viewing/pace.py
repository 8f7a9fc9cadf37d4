"""How many pixels to draw while the camera moves, so that pictures keep up with the hand."""

from __future__ import annotations

import math

# Seconds that a picture may take while the camera moves, and without a movement after which it is drawn in full.
MOVING_S, STILL_S = 0.12, 0.25

# The smallest fraction of the width and height that is drawn.
COARSEST = 1 / 8

# The weight of the newest picture in the estimate.
NEWEST = 0.5


class Pace:
    """Learns from each picture how long a pixel takes."""

    def __init__(self) -> None:
        self._seconds_per_pixel: float | None = None  # None: nothing has been drawn yet

    def learn(self, pixels: int, seconds: float) -> None:
        """Take note of a picture."""
        newest, before = seconds / pixels, self._seconds_per_pixel
        self._seconds_per_pixel = newest if before is None else NEWEST * newest + (1 - NEWEST) * before

    def fraction(self, pixels: int) -> float:
        """The fraction of the width and height of a picture of so many pixels that can be drawn in time."""
        if self._seconds_per_pixel is None:
            return COARSEST
        affordable = math.sqrt(MOVING_S / (self._seconds_per_pixel * max(1, pixels)))
        return min(1.0, max(COARSEST, affordable))
