"""How far a start's splats are merged, as a whole and in tiles."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects

Made = TypeVar("Made")

# The powers of `merge_to` that are tried: the last, the mildest, and then the others, until merging loses little enough.
POWERS = (1, 1 / 2, 1 / 4)

# dB that the mildest merging may cost before steps for a renderer that draws otherwise than the training did, even if the settings allow less: fewer
# splats learn that sooner, and better. What stronger merging costs does not come back (docs/recipes_found.md).
MILD_COSTS = 0.6


def mildest_costs(config: AdaptConfig, base: Effects, target: Effects) -> float:
    """dB that the mildest merging may cost."""
    learns = config.steps > 0 and base != target and config.merging_costs
    return max(config.merging_costs, MILD_COSTS) if learns else config.merging_costs


def strongest(tried: Callable[[float], tuple[Made, float, bool] | None], formed_db: float) -> Made | None:
    """What is made by the strongest merging that suits; None if merging costs too much.

    `tried`: of a power of `merge_to` what is made, its dB, and whether it suits, or None where there is no time; `formed_db`: before merging.
    If the mildest merging already loses too much, as with captures, no stronger one is tried. If the mildest gains, a stronger one is tried
    even where the base as it is looks better, since it may be better than both.
    """
    if (mildest := tried(POWERS[-1])) is None:
        return None
    made, psnr, suits = mildest
    for power in POWERS[:-1] if suits or psnr >= formed_db else ():
        if (stronger := tried(power)) is None:
            break
        if stronger[2]:
            return stronger[0]
    return made if suits else None
