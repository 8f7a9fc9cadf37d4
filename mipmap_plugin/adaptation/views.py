"""Which views are adapted to, and in which order: introduced one after the other, then repeated in rounds. All follows from one seed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from mipmap_plugin.adaptation.spreading import Halves, places, spread
from mipmap_plugin.adaptation.viewpoints import Viewpoints
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import SettingsError, plural
from mipmap_plugin.limits import derived_seed
from mipmap_plugin.scenes.orbits import GOLDEN, ORBIT_FOV
from mipmap_plugin.scenes.trajectories import jittered, with_company

# A checkpoint without cameras does not say at what resolution it was trained: this many px across 50 degrees is NeRF-Synthetic's.
ORBIT_PIXELS = 800
ORBIT_VIEWS = 50


class ViewSchedule:
    """The views that each step uses. It has no state, so that a run can be resumed at any step."""

    def __init__(self, views: Sequence[Camera], config: AdaptConfig) -> None:
        self._rounds, self._seed, self._steps = Rounds(views, config.seed, spread_out=config.order == "spread"), config.seed, config.steps
        self._max_views, self._warm_up = min(config.views_per_step, len(views)), config.warm_up_steps
        self._gathering = math.ceil(config.gathering * config.steps)  # steps during which new views are introduced

    @property
    def view_count(self) -> int:
        """The number of views."""
        return len(self._rounds.views)

    def __call__(self, step: int, progress: float) -> list[Camera]:
        """Return the views of a step: at first its new views and some of the earlier ones, later the next ones of a round through all.

        progress: 0..1, how much of the run is over; with a time budget this may be more than the step number implies.
        """
        pace, count = max(step, int(progress * self._steps)), self._views_in_step(step)
        if pace >= self._gathering:
            first = self.draws_before(step)
            return [self._rounds(first + number) for number in range(count)]
        before, after = self._introduced(pace - 1), self._introduced(pace)
        new = range(before, min(after, before + count))
        generator = torch.Generator().manual_seed(derived_seed(self._seed, step))
        repeated = torch.randperm(before, generator=generator)[: count - len(new)].tolist()
        return [self._rounds(draw) for draw in (*new, *repeated)]

    def _views_in_step(self, step: int) -> int:
        """The number of views of a step. It rises during the warm-up: the first gradients are alike in all views, so few views suffice."""
        return self._max_views if self._warm_up <= max(0, step) else math.ceil(self._max_views * (step + 1) / self._warm_up)

    def draws_before(self, step: int) -> int:
        """The number of draws of all earlier steps; that of the warm-up is rounded up to whole steps, so that rounds align with steps."""
        if step < self._warm_up:
            return self._draws_in_warm_up(step)
        return (math.ceil(self._draws_in_warm_up(self._warm_up) / self._max_views) + step - self._warm_up) * self._max_views

    def _draws_in_warm_up(self, step: int) -> int:
        """The number of draws of all earlier steps of the warm-up: from which step on each has a first view, a second one, ..."""
        return sum(max(0, step - number * self._warm_up // self._max_views) for number in range(self._max_views))

    def _introduced(self, step: int) -> int:
        """The number of views introduced up to a step: spread evenly, at least one per step, and no more per step than it uses."""
        count = max(self._views_in_step(step), step + 1, math.ceil(len(self._rounds.views) * (step + 1) / self._gathering))
        return min(count, self.draws_before(step + 1), len(self._rounds.views))


class Rounds:
    """Each view once per round, in an order that follows from (seed, round) alone, so that a run can be resumed at any step."""

    def __init__(self, views: Sequence[Camera], seed: int, *, spread_out: bool = False) -> None:
        """`spread_out`: neighbors look from all sides; otherwise the order is shuffled."""
        self.views, self._seed = list(views), seed
        self._halves = Halves.of(range(len(views)), places(views)) if spread_out and views else None
        self._round = -1
        self._order: list[int] = []

    def __call__(self, draw: int) -> Camera:
        """The `draw`-th view since the beginning of the run."""
        round_number, position = divmod(draw, len(self.views))
        if round_number != self._round:
            self._round, self._order = round_number, self._order_of(round_number)
        return self.views[self._order[position]]

    def _order_of(self, round_number: int) -> list[int]:
        generator = torch.Generator().manual_seed(derived_seed(self._seed, round_number))
        if self._halves is not None:
            return spread(self._halves, generator)
        return torch.randperm(len(self.views), generator=generator).tolist()


def extent(views: Sequence[Camera]) -> float:
    """The extent of a scene in world units: 1.1 times the largest distance of a camera from the cameras' mean (INRIA's `spatial_lr_scale`).

    It is 1 for a single camera, or for several in one place, which tell nothing about the scene's size.
    """
    centers = torch.stack([view.center for view in views])
    radius = 1.1 * float((centers - centers.mean(0)).norm(dim=1).max())
    return radius if radius > 0 else 1.0


def choose_views(cameras: Sequence[Camera], viewpoints: Viewpoints, config: AdaptConfig) -> tuple[list[Camera], str]:
    """Return the base-scale cameras to adapt to, and a description of them. `viewpoints`: where generated views are.

    Raises SettingsError when the policy finds no cameras.
    """
    generator = torch.Generator().manual_seed(config.seed)
    if config.views == "orbit" or not cameras:
        pixels = math.ceil(2 * math.tan(ORBIT_FOV / 2) * cameras[0].fx) if cameras else ORBIT_PIXELS  # the cameras' own focal length
        orbit, count = viewpoints.orbit, config.extra_views or ORBIT_VIEWS
        views = viewpoints.views((pixels, pixels), count, generator)
        reason = "as requested" if cameras else "the checkpoint came without cameras"
        told = f" {orbit.told()}," if orbit.up else ""
        return views, f"{plural(len(views), 'view')} of a generated orbit{told} at {pixels} px ({reason})"
    if config.views == "given":
        return list(cameras), f"the {plural(len(cameras), 'given view')}"
    split = "test" if config.views == "test" else "train"
    views = [camera for camera in cameras if camera.split == split]
    if not views:
        raise SettingsError(f"there are no {split} views among the {plural(len(cameras), 'camera')}; use the view policy 'given'")
    if config.views == "jittered":
        extra = jittered(with_company(views, viewpoints.orbit), config.extra_views, generator)
        return views + extra, f"{plural(len(views), 'train view')} and {len(extra)} around them"
    return views, f"the {plural(len(views), f'{split} view')}"


def over_band(views: Sequence[Camera], config: AdaptConfig) -> list[Camera]:
    """The views of the base scale, each at one multiple of it out of the settings' band, evenly spread over the band's logarithm."""
    low, high = config.band
    if low == high == 1:
        return list(views)
    return [view.zoomed(low * (high / low) ** ((number + 0.5) * GOLDEN % 1)) for number, view in enumerate(views)]


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
