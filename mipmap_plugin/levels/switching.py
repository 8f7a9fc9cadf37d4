"""Where a viewer should change from one level to the next: where both are equally good, so that the worse of the two is as good as possible."""

from __future__ import annotations

import math
from collections.abc import Sequence


def crossing(zooms: Sequence[float], finer_db: Sequence[float], coarser_db: Sequence[float]) -> float:
    """The zoom at which two levels, measured at rising `zooms`, are equally good.

    Between two zooms, dB are interpolated along the logarithm of the zoom. Of several crossings the one of the highest dB is
    returned; if there is none, the zoom at which the levels differ least.
    """
    gaps = [fine - coarse for fine, coarse in zip(finer_db, coarser_db, strict=True)]
    found = []
    for i in range(len(zooms) - 1):
        if gaps[i] <= 0 < gaps[i + 1]:
            part = gaps[i] / (gaps[i] - gaps[i + 1])
            log_zoom = (1 - part) * math.log(zooms[i]) + part * math.log(zooms[i + 1])
            found.append(((1 - part) * coarser_db[i] + part * coarser_db[i + 1], math.exp(log_zoom)))
    if found:
        return max(found)[1]
    return min(zip(map(abs, gaps), zooms, strict=True))[1]


def zooms_between(low: float, high: float, step: float) -> list[float]:
    """Rising zooms from `low` to `high`, both included, evenly spaced in the logarithm, at most a factor of `step` apart."""
    count = max(1, math.ceil(math.log(high / low) / math.log(step) - 1e-9)) if high > low else 0
    return [low * (high / low) ** (number / count) for number in range(count)] + [high]
