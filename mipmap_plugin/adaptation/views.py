"""Which views are adapted to, and in which order: gathered in a shuffled order, then in rounds through all of them, from one seed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.limits import mixed
from mipmap_plugin.scenes.trajectories import ORBIT_FOV, jittered, orbit

# A checkpoint without cameras does not say how finely it was trained: this many px across 50 degrees is NeRF-Synthetic's density.
ORBIT_PIXELS = 800
ORBIT_VIEWS = 50


class Order:
    """Which views each step takes. Remembers nothing, so that a run can be resumed at any."""

    def __init__(self, views: Sequence[Camera], config: AdaptConfig) -> None:
        self._rounds, self._seed, self._steps = Rounds(views, config.seed), config.seed, config.steps
        self._most, self._warm_up = min(config.views_per_step, len(views)), config.warm_up_steps
        self._gathering = math.ceil(config.gathering * config.steps)

    def __call__(self, step: int, progress: float) -> list[Camera]:
        """The views of a step: while they are gathered its new ones and some of those before, then rounds through all.

        progress: 0..1, how much of the run is over; more than the steps tell where time is short.
        """
        pace, each = max(step, int(progress * self._steps)), self._each(step)
        if pace >= self._gathering:
            first = self._drawn(step)
            return [self._rounds(first + nth) for nth in range(each)]
        before, known = self._known(pace - 1), self._known(pace)
        new = range(before, min(known, before + each))
        generator = torch.Generator().manual_seed(mixed(self._seed, step))
        again = torch.randperm(before, generator=generator)[: each - len(new)].tolist()
        return [self._rounds(place) for place in (*new, *again)]

    def _each(self, step: int) -> int:
        """How many views a step takes: few at first, when any of them tells where to go."""
        return self._most if self._warm_up <= max(0, step) else math.ceil(self._most * (step + 1) / self._warm_up)

    def _drawn(self, step: int) -> int:
        """How many the steps before took; those of the warm-up rounded up to whole steps, so that rounds and steps still meet."""
        first = sum(self._each(before) for before in range(min(step, self._warm_up)))
        return first if step < self._warm_up else math.ceil(first / self._most) * self._most + (step - self._warm_up) * self._most

    def _known(self, step: int) -> int:
        """How many views have come in with a step: evenly over the steps of gathering, at least one and no more in a step than it takes."""
        come = max(self._each(step), step + 1, math.ceil(len(self._rounds.views) * (step + 1) / self._gathering))
        return min(come, self._drawn(step + 1), len(self._rounds.views))


class Rounds:
    """Every view once per round, in an order that follows from (seed, round) alone, so that any step can be resumed."""

    def __init__(self, views: Sequence[Camera], seed: int) -> None:
        self.views, self._seed = list(views), seed
        self._round = -1
        self._order: list[int] = []

    def __call__(self, draw: int) -> Camera:
        """The `draw`-th view since the beginning."""
        turn, place = divmod(draw, len(self.views))
        if turn != self._round:
            generator = torch.Generator().manual_seed(mixed(self._seed, turn))
            self._round, self._order = turn, torch.randperm(len(self.views), generator=generator).tolist()
        return self.views[self._order[place]]


def extent(views: Sequence[Camera]) -> float:
    """World units: 1.1 times the largest distance of a camera from their mean, INRIA's `spatial_lr_scale`.

    A single camera, or several in one place, say nothing about size: then it is 1.
    """
    centers = torch.stack([view.center for view in views])
    radius = 1.1 * float((centers - centers.mean(0)).norm(dim=1).max())
    return radius if radius > 0 else 1.0


def choose_views(cameras: Sequence[Camera], means: Tensor | Gaussians, config: AdaptConfig) -> tuple[list[Camera], str]:
    """The base-scale cameras to adapt on, and a sentence that says which. `means` [N, 3]: what an orbit goes around.

    Raises SettingsError when the policy finds none.
    """
    generator = torch.Generator().manual_seed(config.seed)
    if config.views == "orbit" or not cameras:
        pixels = math.ceil(2 * math.tan(ORBIT_FOV / 2) * cameras[0].fx) if cameras else ORBIT_PIXELS  # the cameras' own focal length
        views = orbit(means, (pixels, pixels), config.extra_views or ORBIT_VIEWS, generator)
        why = "asked for" if cameras else "the checkpoint came without cameras"
        return views, f"{len(views)} views of a generated orbit at {pixels} px ({why})"
    if config.views == "given":
        return list(cameras), f"the {len(cameras)} given views"
    split = "test" if config.views == "test" else "train"
    views = [camera for camera in cameras if camera.split == split]
    if not views:
        raise SettingsError(f"there are no {split} views among the {len(cameras)} cameras; ask for the views 'given'")
    if config.views == "jittered":
        extra = jittered(views, config.extra_views, generator)
        return views + extra, f"{len(views)} train views and {len(extra)} around them"
    return views, f"the {len(views)} {split} views"


def with_times(views: Sequence[Camera], seed: int) -> tuple[list[Camera], str]:
    """The views of a moving scene, each at a time, and a sentence that says how.

    Views without a time get times evenly spread over 0..1, both ends included, in a random order, so that the time does not
    follow the path of the cameras.
    """
    timeless = [number for number, view in enumerate(views) if view.time is None]
    if not timeless:
        return list(views), "at their own times"
    order = torch.randperm(len(timeless), generator=torch.Generator().manual_seed(seed)).tolist()
    times = {number: place / max(1, len(timeless) - 1) for number, place in zip(timeless, order, strict=True)}
    timed = [replace(view, time=times.get(number, view.time)) for number, view in enumerate(views)]
    return timed, f"{len(timeless)} of them without a time, which are spread over 0..1"
