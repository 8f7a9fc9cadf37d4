"""How many steps a scene can have: fewer where each view shows very many splats, so that large scenes take minutes and not hours."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch

from mipmap_plugin.adaptation.views.for_validation import MIN_VIEWS
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.models.base import SplatModel

# Views and splats that are counted, to estimate how many splats a view shows; with more, the result changes by a few percent.
VIEWS, SPLATS = 12, 1 << 16

# At least this fraction of the steps is taken: it costs 1 to 3 dB of what all of them reach (docs/recipes_found.md), and fewer were not tried.
LEAST_FRACTION = 1 / 4

# Splats that a second of a time budget is taken to draw: those of `default` at most (`recipes.MOST_DRAWS`) over its minute on two cores. The moments
# of a moving scene follow from this and not from the clock, so that a run can be resumed.
DRAWS_A_SECOND = 3e6

# The fraction of a run's draws that may be spent on moments, the number of times that each moment is evaluated, and the least number of moments.
FOR_MOMENTS, ROUNDS, LEAST_MOMENTS = 1 / 2, 5, 6

# The same in a time budget, where steps are worth even more than further moments (docs/recipes_found.md).
FOR_MOMENTS_IN_BUDGET, LEAST_IN_BUDGET = 1 / 6, 2

# Splats in all validation views together, for each second of a time budget. Each view is drawn in many checks, or in every state that is chosen from:
# as many views as without a budget would take a quarter of a run of two seconds.
VALIDATED_A_SECOND = 1e5

# The part of a time budget that looking at views may take, to find those that see a capture clearly.
FOR_LOOKS = 1 / 4

# Of a large scene, the base is drawn at most so many times finer than the target.
OVERSAMPLING = 3


def looks_in_budget(config: AdaptConfig, base: SplatModel) -> float:
    """How many views of a model a time budget allows to look at (`viewpoints.Viewpoints`)."""
    budget = math.inf if config.time_budget_s is None else FOR_LOOKS * config.time_budget_s
    return budget * DRAWS_A_SECOND / max(1, len(base.parameters()["means"]))


@torch.no_grad()
def splats_in_view(means: torch.Tensor, views: Sequence[Camera], near: float) -> float:
    """The number of splats whose `means` [N, 3] lie in a view, mean of some views."""
    some = means[:: max(1, -(-len(means) // SPLATS))]
    shares = [float(view.in_picture(view.to_camera(some), near).float().mean()) for view in evenly(views, VIEWS)]
    return len(means) * sum(shares) / max(1, len(shares))


def affordable_moments(config: AdaptConfig, base: SplatModel) -> int | None:
    """The number of moments that a moving scene can be adapted at: all that the settings have, or what fits into the time of a run."""
    if config.moments is None or not base.traits.moves:
        return config.moments
    if config.time_budget_s is not None:
        draws, least = FOR_MOMENTS_IN_BUDGET * DRAWS_A_SECOND * config.time_budget_s, LEAST_IN_BUDGET
    elif config.most_draws is not None:
        draws, least = FOR_MOMENTS * config.most_draws, LEAST_MOMENTS
    else:
        return config.moments
    return min(config.moments, max(least, int(draws / max(1.0, ROUNDS * _evaluation(base)))))


def _evaluation(base: SplatModel) -> float:
    """The cost of evaluating one moment of a moving scene: the number of splats that are drawn in the same time."""
    return len(base.parameters()["means"]) * float(getattr(base, "work", 0.0))


def takes_steps(config: AdaptConfig, scale: float, base: Effects, targets: Iterable[Effects]) -> bool:
    """Whether steps are worth taking: at the smallest zoom-ins only where another way to draw is to be learned. `base`: how that is rendered."""
    small = 1 < scale < config.least_zoom_in and all(target == base for target in targets)
    return config.steps > 0 and not small


def affordable_for_model(config: AdaptConfig, base: SplatModel, views: Sequence[Camera], near: float) -> AdaptConfig:
    """`affordable_for` a model's splats, with as many views for validation as a time budget allows.

    Draws that the moments of a moving scene take are not available for steps.
    """
    means = base.parameters()["means"]
    if config.time_budget_s is not None:
        in_views = splats_in_view(means, views, near) if views else len(means)
        most_views = max(MIN_VIEWS, int(VALIDATED_A_SECOND * config.time_budget_s / max(1.0, in_views)))
        config = config.model_copy(update={"validation_views": min(config.validation_views, most_views)})
    if config.most_draws is None or not (base.traits.moves or base.traits.same_for_all_views):
        return config
    moments = ROUNDS * (affordable_moments(config, base) or 0) * _evaluation(base)
    left = config.model_copy(update={"most_draws": max(config.most_draws - moments, (1 - FOR_MOMENTS) * config.most_draws)})
    fewer = affordable_for(left, means, views, near)
    return fewer.model_copy(update={"most_draws": config.most_draws})


def affordable_for(config: AdaptConfig, means: torch.Tensor, views: Sequence[Camera], near: float) -> AdaptConfig:
    """`affordable` for a scene of splats at `means` [N, 3]; the settings themselves where there are no views to count splats in."""
    if config.most_draws is None or not views:
        return config
    return affordable(config, splats_in_view(means, views, near))


def affordable(config: AdaptConfig, in_view: float) -> AdaptConfig:
    """The settings with as many steps as `most_draws` allows, where a view shows `in_view` splats."""
    if config.most_draws is None:
        return config
    most = int(config.most_draws / max(1.0, in_view * config.views_per_step))
    fraction = min(1.0, max(most / max(1, config.steps), LEAST_FRACTION))
    return config if fraction == 1 else _fewer(config, fraction)


def _fewer(config: AdaptConfig, fraction: float) -> AdaptConfig:
    """The settings with a fraction of the steps.

    Fewer steps have fewer extra views, of which each costs a picture of the base, and smaller pictures, as good for them (docs/recipes_found.md).
    """
    fewer = {"steps": math.ceil(fraction * config.steps), "extra_views": math.ceil(fraction**0.5 * config.extra_views)}
    if config.truth_oversampling is not None:
        fewer["truth_oversampling"] = min(OVERSAMPLING, config.truth_oversampling)
    return config.model_copy(update=fewer)


def as_taken(config: AdaptConfig, taken: AdaptConfig) -> AdaptConfig:
    """What `affordable` makes of these settings for the scene for which it made `taken`, of these or of others.

    Which fraction of the steps that was is known from `taken`. Steps are rounded up, so that the number of extra views is known to one or a few.
    """
    if config.most_draws is None or not LEAST_FRACTION * config.steps <= taken.steps < config.steps:
        return config
    least, most = (_fewer(config, steps / config.steps) for steps in (taken.steps - 1, taken.steps))
    extra_views = min(max(taken.extra_views, least.extra_views), most.extra_views)
    return most.model_copy(update={"steps": taken.steps, "extra_views": extra_views})


def fewer_note(asked_steps: int, config: AdaptConfig) -> str:
    """Why a run took fewer steps than it was asked for, in brackets; empty if it did not."""
    if asked_steps and not config.steps:
        return f" (of {asked_steps}, because a zoom below x{config.least_zoom_in:g} shows hardly more than the base; --steps takes them)"
    return f" (of {asked_steps}, because the scene is large; --steps takes more)" if config.steps < asked_steps else ""
