"""The moments of a moving scene: which ones views are adapted at, and when the field is evaluated for the base."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from itertools import chain, zip_longest

import torch

from mipmap_plugin.camera import Camera
from mipmap_plugin.models.base import SplatModel

# The most moments at which states are compared at the end: the field is evaluated anew at each, for each state.
CHOOSING = 8

# A time that more than this fraction of the views have is always one of the moments: the live view adapts a third of them to what it shows.
MANY = 1 / 4


def with_times(views: Sequence[Camera], seed: int) -> tuple[list[Camera], str]:
    """Give each view of a moving scene a time; return the views and a description of their times.

    Views without a time get times evenly spread over 0..1, both ends included, in a random order, so that the time does not
    follow the path of the cameras.
    """
    timeless = [number for number, view in enumerate(views) if view.time is None]
    if not timeless:
        return list(views), "at their own times"
    order = torch.randperm(len(timeless), generator=torch.Generator().manual_seed(seed)).tolist()
    times = {number: position / max(1, len(timeless) - 1) for number, position in zip(timeless, order, strict=True)}
    timed = [replace(view, time=times.get(number, view.time)) for number, view in enumerate(views)]
    return timed, f"{len(timeless)} of them without a time of their own, spread over 0..1"


def at_moments(views: Sequence[Camera], most: int | None) -> list[Camera]:
    """The views, each at the nearest of at most so many of their own times: those of many views, and others evenly chosen."""
    counts = Counter(view.time or 0.0 for view in views)
    if most is None or len(counts) <= most:
        return list(views)
    chosen = [time for time, count in counts.most_common(most) if count > MANY * len(views)]
    others, left = sorted(counts.keys() - set(chosen)), most - len(chosen)
    chosen += [others[round(number * (len(others) - 1) / max(1, left - 1))] for number in range(left)]
    nearest = {time: min(chosen, key=lambda moment: abs(moment - time)) for time in counts}
    return [replace(view, time=nearest[view.time or 0.0]) for view in views]


def at_their_moments(views: Sequence[Camera], validation: Sequence[Camera], most: int | None, seed: int) -> tuple[list[Camera], list[Camera], str]:
    """The views and the validation views, of which every second one steers, with their times, at `most` moments or fewer, and a note on these.

    The other validation views, which choose among the states at the end, have moments of their own, since they are held out.
    """
    (views, times), (validation, _) = with_times(views, seed), with_times(validation, seed)
    used = at_moments([*views, *validation[::2]], most)
    steering, choosing = used[len(views) :], at_moments(validation[1::2], most and min(most, CHOOSING))
    before, after = (len({view.time for view in some}) for some in ([*views, *validation[::2]], used))
    paired = [view for view in chain(*zip_longest(steering, choosing)) if view is not None]
    return used[: len(views)], paired, times if after == before else f"{times}, each at the nearest of {after} moments"


def follows(base: SplatModel) -> bool:
    """Whether a moving model keeps the results of its field; one of a third party need not."""
    return base.traits.moves and hasattr(base, "follow")


@torch.no_grad()
def evaluate_moments(base: SplatModel, views: Sequence[Camera], phase: Callable[[str], AbstractContextManager[None]]) -> None:
    """Evaluate the field of a moving scene at each moment of the views, in a `phase` of its own.

    Otherwise the first truth and the first step at each moment would take that long, and the time that is left would be foretold wrongly.
    """
    if follows(base):
        with phase("motion"):
            for view in {view.time: view for view in views}.values():
                base.gaussians(view)
