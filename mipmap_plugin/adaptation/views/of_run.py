"""The views of a run: the policy chooses them, some step back, and some are kept for validation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from torch import Tensor

from mipmap_plugin.adaptation.views.farther import some_farther
from mipmap_plugin.adaptation.views.for_validation import split_validation
from mipmap_plugin.adaptation.views.policy import choose_views
from mipmap_plugin.adaptation.views.shown import telling
from mipmap_plugin.adaptation.views.viewpoints import Viewpoints
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig


def views_of_run(
    cameras: Sequence[Camera], viewpoints: Viewpoints, means_at: Callable[[Camera], Tensor], near: float, scale: float, config: AdaptConfig
) -> tuple[list[Camera], list[Camera], str]:
    """The views to adapt to, those for validation, and a description of the former.

    `means_at`: where the splats are at a view's moment, [N, 3] in world units, as is `near`, the near plane of the base. Raises SettingsError as
    `choose_views` and `some_farther`.
    """
    chosen, note = choose_views(cameras, replace(viewpoints, beside=True), config)
    means = means_at(chosen[0])
    chosen, farther = some_farther(chosen, cameras, means, near, scale, config.farthest)
    views, validation = split_validation(cameras, chosen, viewpoints, scale, config)
    kept = f", {len(chosen) - len(views)} of them kept for validation" if len(views) < len(chosen) else ""
    return views, telling(validation, means, near), note + farther + kept
