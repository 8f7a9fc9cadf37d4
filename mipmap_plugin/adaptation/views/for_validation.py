"""The views for validation, out of the given cameras and around them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from mipmap_plugin.adaptation.views.policy import choose_views
from mipmap_plugin.adaptation.views.viewpoints import Viewpoints
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.scenes.trajectories import jittered, with_company

# At most one in this many of the given cameras is kept for validation, where the policy leaves the choice of views to us.
VALIDATION_EVERY = 16

# One validation view per this many rendered views, so that validation takes at most a tenth of the time; but at least `MIN_VIEWS`.
RENDERS_PER_VIEW = 25
MIN_VIEWS = 4

# At least as many where no step is taken: nothing makes up for a start that is chosen wrongly. With 4, of which one or two see little but the sky,
# an object is left as it is (at x1/4 24.0 dB in place of 28.1, at x2 38.7 in place of 43.1), and 8 take 0.1 to 0.8 s more.
MIN_VIEWS_OF_START = 8

# px: validation uses at most this much of a view along each side, so that large images stay cheap.
WINDOW = 768

# Of a number of pixels that is a whole one, as of a third.
ROUNDING = 1e-6

# Added to the seed for the random views of validation, so that they differ from the views that are adapted to.
SEED_OFFSET = 7919


def split_validation(
    cameras: Sequence[Camera], views: Sequence[Camera], viewpoints: Viewpoints, scale: float, config: AdaptConfig
) -> tuple[list[Camera], list[Camera]]:
    """Return the views to adapt to, out of `views`, and the views for validation.

    For validation: some of the given cameras, where a policy chooses among enough of them, and random views from the region that they
    span; without cameras, the views of another orbit. Of large images only the middle is used; there are no validation views if one
    pixel of the base is larger than that. `viewpoints`: as of `choose_views`.
    """
    if scale > WINDOW:
        return list(views), []
    adapted, validation = _validation_views(cameras, views, viewpoints, config)
    size = _window_side(scale)
    return adapted, [view.window(size, size) for view in validation]


def _window_side(scale: float) -> int:
    """px of the base: at a zoom-out those of whole pixels of the new scale, which a filter of whole blocks (`box`) needs."""
    if scale >= 1:
        return round(WINDOW / scale)
    return min(WINDOW, round(max(1, math.floor(WINDOW * scale + ROUNDING)) / scale))


def count_of_views(config: AdaptConfig) -> int:
    """How many views there are for validation."""
    fewest = MIN_VIEWS if config.steps else MIN_VIEWS_OF_START
    return min(config.validation_views, max(fewest, config.steps * config.views_per_step // RENDERS_PER_VIEW))


def _validation_views(
    cameras: Sequence[Camera], views: Sequence[Camera], viewpoints: Viewpoints, config: AdaptConfig
) -> tuple[list[Camera], list[Camera]]:
    """`split_validation` with whole images. Random views come first in each pair, so that they steer and kept cameras choose."""
    count = count_of_views(config)
    generator = torch.Generator().manual_seed(config.seed + SEED_OFFSET)
    if config.views == "orbit" or not cameras:
        changes = {"views": "orbit", "extra_views": count, "seed": config.seed + SEED_OFFSET}
        validation, _ = choose_views(cameras, viewpoints, config.model_copy(update=changes))
        return list(views), validation
    given = set(cameras)
    originals = [view for view in views if view in given]
    kept: list[Camera] = []
    if config.views in ("train", "jittered"):
        kept = evenly(originals[VALIDATION_EVERY // 2 :], min(count // 2, len(originals) // VALIDATION_EVERY))
    adapted = [view for view in views if view not in kept]
    known = with_company(originals or list(views), viewpoints.orbit)
    random = jittered(known, count - len(kept), generator, spread=False)
    return adapted, [view for pair in zip(random, kept, strict=False) for view in pair] + random[len(kept) :]
