"""Views from farther back than a capture was photographed from: in a viewer, people step back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from mipmap_plugin.adaptation.views.pixel_size import is_unbounded, seen_depth
from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.scenes.photographed import GOLDEN

# The part of a view's splats that lies before what counts as its foreground.
FOREGROUND = 0.1

# One in so many generated views steps back, until its foreground is at most this much smaller. A file for a viewer that is adapted to views from
# near the photographs' places alone may be worse than its base elsewhere: one of a phone's capture in PlayCanvas by 2.2 dB where the foreground
# is half as large, and with these views better by 0.6. Near the photographs' places they change -0.3 to 0.6 dB; from farther back they would cost.
FARTHER_EVERY, FARTHEST = 3, 0.5

# So many splats tell how far away a view's foreground is: a thousand views of a million splats would take half a minute.
TELLING = 1 << 16


def backed(view: Camera, way: float) -> Camera:
    """The view from `way` world units farther back."""
    viewmat = view.viewmat.clone()
    viewmat[2, 3] += way
    return replace(view, viewmat=viewmat)


def foreground(view: Camera, means: Tensor, near: float) -> float:
    """The depth of the nearest parts of a view, in world units; infinity where it sees nothing. `means` [N, 3]."""
    return seen_depth(view, means, near, FOREGROUND)


def stepping_back(views: Sequence[Camera], means: Tensor, near: float, smallest: float) -> list[Camera]:
    """The views from farther back: their foreground is from x1 to `smallest` as large, evenly in the logarithm. One that sees nothing stays.

    `means` [N, 3] in world units, as is `near`, the near plane.
    """
    found, some = [], means[:: max(1, len(means) // TELLING)]
    for number, view in enumerate(views):
        depth, scale = foreground(view, some, near), smallest ** ((number + 0.5) * GOLDEN % 1)
        found.append(backed(view, depth * (1 / scale - 1)) if math.isfinite(depth) else view)
    return found


def some_farther(
    views: Sequence[Camera], given: Sequence[Camera], means: Tensor, near: float, scale: float, farthest: float | None
) -> tuple[list[Camera], str]:
    """`views`, with some of those that are not `given` from farther back (`FARTHER_EVERY`), and what to say of that.

    `farthest`: as in the settings. None: at x1, a file for a viewer, in which people step back. For another scale they do so before; and a bounded
    scene is only smaller from there, as at a smaller scale. `means`, `near`: as of `stepping_back`. Raises SettingsError where none could step back.
    """
    known = set(given)
    some = [view for view in views if view not in known][::FARTHER_EVERY]
    if farthest is None:
        around_given = scale == 1 and len(some) > 0 and any(view in known for view in views)
        farthest = FARTHEST if around_given and is_unbounded(means, given, near) else 1.0
    if farthest == 1:
        return list(views), ""
    if not some:
        raise SettingsError("farthest: all views are given ones, and only generated ones step back; take the views jittered, or leave farthest out")
    farther = dict(zip(some, stepping_back(some, means, near, farthest), strict=True))
    return [farther.get(view, view) for view in views], f", {len(farther)} of these from farther back"
