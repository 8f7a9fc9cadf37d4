"""Where a viewer should change from one level to the next: where both are equally good, and the worse of the two as good as possible."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

# A switch is first sought among zooms that are this factor apart, and then about the best of them. Nothing is interpolated: an image has a
# whole number of pixels, so that dB change in steps, which at x1/16 of 200 pixels are up to 3 dB high.
FIRST_STEP, SECOND_STEP = 2**0.25, 2 ** (1 / 32)

# dB: a smaller difference between two levels counts as none.
EVEN = 0.5


def switching_zoom(low: float, high: float, measure: Callable[[float], tuple[float, float]]) -> float:
    """The zoom between `low` and `high` for a switch. `measure` returns the dB of the finer and of the coarser level at a zoom."""
    zooms = zooms_between(low, high, FIRST_STEP)
    best = most_even([measure(zoom) for zoom in zooms])
    closer = zooms_between(zooms[max(best - 1, 0)], zooms[min(best + 1, len(zooms) - 1)], SECOND_STEP)
    return closer[most_even([measure(zoom) for zoom in closer])]


def most_even(pairs: Sequence[tuple[float, float]]) -> int:
    """Which of several pairs of dB, of the finer and of the coarser level at rising zooms, is the best for a switch.

    The one that differs least; of those that differ by at most `EVEN`, the one whose worse dB are best. Where one level is better throughout, no
    zoom is even, and nothing is gained by showing the other: the first, if that is the finer level, else the last.
    """
    better = [finer - coarser for finer, coarser in pairs]
    if min(better) > EVEN:
        return 0
    if max(better) < -EVEN:
        return len(pairs) - 1
    return max(range(len(pairs)), key=lambda index: (-max(abs(better[index]), EVEN), min(pairs[index])))


def zooms_between(low: float, high: float, step: float) -> list[float]:
    """Rising zooms from `low` to `high`, both included, evenly spaced in the logarithm, at most a factor of `step` apart."""
    count = max(1, math.ceil(math.log(high / low) / math.log(step) - 1e-9)) if high > low else 0
    return [low * (high / low) ** (number / count) for number in range(count)] + [high]
