"""One file for several viewers: which of them speak for the rest, and which of them the start aims at.

A splat that is right in two viewers is right in one between them: between two dilations, between what compensates and what does not, and
where less is left out. So steps draw the extremes alone, in turn. On lego at x1/4 that makes the worst of all viewers 0.7 dB better than
turns through all of them, half of which draw much alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from statistics import median_low
from typing import Any

from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import COMPENSATED, Effects

# Of a recipe's `merge_to`: fewer, larger splats care less about a filter. At x1/4 half of them makes the worst viewer 0.3 dB better on lego,
# and a quarter no better than that.
FEWER = 0.5


def for_several(config: AdaptConfig) -> dict[str, Any]:
    """What a recipe's settings become. The loss is the square itself instead of its logarithm, so that the worst viewer counts most:
    +0.9 dB there on lego at x1/4, +0.5 on flowers."""
    return {"merge_to": config.merge_to * FEWER if config.merge_to < 1 else 1.0, "loss": "l2" if config.loss == "psnr" else config.loss}


def extremes(targets: Mapping[str, Effects]) -> dict[str, Effects]:
    """Those of `targets` that go farthest in one respect, of equals the first: the widest dilation with and without compensation, the
    narrowest, and what is left out most or changed most for its size."""
    respects: tuple[Callable[[Effects], tuple[float, ...]], ...] = (
        lambda effects: (0.0 if _compensates(effects) else effects.eps2d,),
        lambda effects: (effects.eps2d if _compensates(effects) else 0.0,),
        lambda effects: (-effects.eps2d,),
        lambda effects: (effects.settings.min_variance, effects.settings.min_contribution),
        lambda effects: (effects.settings.least_spread,),
    )
    found = [max(targets, key=lambda name: respect(targets[name])) for respect in respects]
    return {name: targets[name] for name in targets if name in found}


def middle(targets: Mapping[str, Effects]) -> Effects:
    """What a start aims at, which leads to all of `targets` from the nearest: the median dilation without compensation."""
    dilating = [effects for effects in targets.values() if not _compensates(effects)] or list(targets.values())
    median = median_low(effects.eps2d for effects in dilating)
    return next(effects for effects in dilating if effects.eps2d == median)


def _compensates(effects: Effects) -> bool:
    return effects.screen_filter in COMPENSATED
