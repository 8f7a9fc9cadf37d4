"""One file for several viewers: which of them are rendered during the optimization, and which one the start is made for.

A splat that is right in two viewers is right in one between them: between two dilations, with or without compensation, and where fewer
splats are left out. So steps render the extreme viewers only, in turn, and not all of them, half of which render much alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from statistics import median_low
from typing import Any

from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.screen_filters import COMPENSATED

# Factor of a recipe's `merge_to`: fewer, larger splats depend less on the filter; a smaller factor gains no more.
MERGE_FACTOR = 0.5

# dB that merging may cost before the first step, as that of coarse levels: steps mostly regain more (docs/recipes_found.md has by how much).
MERGING_COSTS = 3.0


def settings_for_several(config: AdaptConfig) -> dict[str, Any]:
    """The changes of a recipe's settings. The loss is the mean square error instead of its logarithm, so that the worst viewer counts most."""
    merge_to = config.merge_to * MERGE_FACTOR if config.merge_to < 1 else 1.0
    costs = MERGING_COSTS if config.steps else config.merging_costs
    return {"merge_to": merge_to, "merging_costs": costs, "loss": "l2" if config.loss == "psnr" else config.loss}


def extreme_targets(targets: Mapping[str, Effects]) -> dict[str, Effects]:
    """The viewers among `targets` that are extreme in one respect; of equals the first.

    These are: the widest dilation without compensation; the widest with it and, of equally wide ones, the lowest limit of colors; the narrowest
    dilation; and what leaves out most splats, or stretches them most, for their size. With compensation that is Spark, which also sorts by
    distance, and not gsplat's antialiased mode (docs/recipes_found.md).
    """
    respects: tuple[Callable[[Effects], tuple[float, ...]], ...] = (
        lambda effects: (0.0 if _compensates(effects) else effects.eps2d,),
        lambda effects: (effects.eps2d, -(effects.settings.max_color or math.inf)) if _compensates(effects) else (0.0, -math.inf),
        lambda effects: (-effects.eps2d,),
        lambda effects: (effects.settings.min_variance, effects.settings.min_contribution),
        lambda effects: (effects.settings.least_spread,),
    )
    extremes = [max(targets, key=lambda name: respect(targets[name])) for respect in respects]
    return {name: targets[name] for name in targets if name in extremes}


def median_target(targets: Mapping[str, Effects]) -> Effects:
    """The target that a start is made for, as close as possible to all of `targets`: the one of median dilation without compensation."""
    dilating = [effects for effects in targets.values() if not _compensates(effects)] or list(targets.values())
    median = median_low(effects.eps2d for effects in dilating)
    return next(effects for effects in dilating if effects.eps2d == median)


def _compensates(effects: Effects) -> bool:
    return effects.screen_filter in COMPENSATED
