"""How many steps a scene can have: fewer where each view shows very many splats, so that large scenes take minutes and not hours."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.models.base import SplatModel

# Views and splats that are counted; more change the result by a few percent.
VIEWS, SPLATS = 12, 1 << 16

# At least this fraction of the steps is taken: it costs 1 to 3 dB of what all of them reach (docs/recipes.md), and fewer were not tried.
LEAST_FRACTION = 1 / 4

# The base is drawn so many times finer than the target at most.
OVERSAMPLING = 3


@torch.no_grad()
def splats_in_view(model: SplatModel, views: Sequence[Camera], near: float) -> float:
    """The number of splats whose centers lie in a view, mean of some views."""
    means = model.parameters()["means"]
    some = means[:: max(1, len(means) // SPLATS)]
    shares = [_in_frame(some, view, near) for view in evenly(views, VIEWS)]
    return len(means) * sum(shares) / max(1, len(shares))


def _in_frame(means: torch.Tensor, view: Camera, near: float) -> float:
    x, y, z = view.to_camera(means).unbind(1)
    u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
    inside = (z > near) & (u > 0) & (u < view.width) & (v > 0) & (v < view.height)
    return float(inside.float().mean())


def affordable(config: AdaptConfig, in_view: float) -> AdaptConfig:
    """The settings with as many steps as `most_draws` allows, where a view shows `in_view` splats.

    Fewer steps have fewer extra views, of which each costs a picture of the base, and smaller pictures: with a fourth of the steps, half of the
    extra views are as good on flowers and better on bird, and the base drawn three times as fine as the target is worth what four times are.
    """
    if config.most_draws is None:
        return config
    most = int(config.most_draws / max(1.0, in_view * config.views_per_step))
    fraction = min(1.0, max(most / max(1, config.steps), LEAST_FRACTION))
    if fraction == 1:
        return config
    fewer = {"steps": math.ceil(fraction * config.steps), "extra_views": math.ceil(fraction**0.5 * config.extra_views)}
    if config.truth_oversampling is not None:
        fewer["truth_oversampling"] = min(OVERSAMPLING, config.truth_oversampling)
    return config.model_copy(update=fewer)
