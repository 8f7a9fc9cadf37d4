"""Which views are adapted to, and in which order: introduced one after the other, then repeated in rounds. All follows from one seed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import compress
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from mipmap_plugin.adaptation.parallel import in_batches
from mipmap_plugin.adaptation.spreading import Halves, places, spread
from mipmap_plugin.adaptation.viewpoints import Viewpoints
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.limits import check_image, derived_seed
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.models.contract import row_opacities
from mipmap_plugin.models.health import units
from mipmap_plugin.progress import announced
from mipmap_plugin.render_settings import MIN_ALPHA
from mipmap_plugin.scenes import unread_cameras
from mipmap_plugin.scenes.orbits import FRAMED, GOLDEN, ORBIT_FOV, Orbit
from mipmap_plugin.scenes.trajectories import jittered, with_company

# A checkpoint without cameras does not say at what resolution it was trained: this many px across 50 degrees is NeRF-Synthetic's.
ORBIT_PIXELS = 800
ORBIT_VIEWS = 50

# Views that are looked at to see whether they show anything; and the mean fraction of their splats in front of the near plane that is worth a word.
# Floaters lie close to cameras, but captures in usual units have no splats there; made ten times smaller they have 2 %, twenty times smaller half.
LOOKED_AT, TOO_MANY = 16, 0.05

# A scene that no view shows larger than so many px, or than this fraction of a picture's shorter side, is too small to adapt. In views of an orbit it
# fills nearly all of a picture, unless it has such small units that the near plane keeps cameras farther away than a user's.
LEAST_PIXELS, LEAST_SHARE = 16, 0.25

# What to do about a scene in units so small that the near plane hides it.
SCALE_UP = "scale the scene up, with its cameras if it has any"

# What is said where there are no cameras: with those of an object all is well, but those of a capture are a guess, which may cost 10 dB and more.
ORBITED = (
    "no cameras are known: views of a generated orbit are adapted to, {told}, and all dB are of such{seems}; "
    "give the scene's cameras (--cameras)"
)
CAPTURE = "; this seems to be a capture, and from where it was photographed is a guess: seen from there it may look worse than its base"
VIEWED = ", or adapt for what you look at (mipmap-plugin view)"

# Lenses whose focal lengths (px) have a larger ratio need different files, as scales of that ratio do. A ratio of 5 costs a capture 10 of 12 dB.
UNLIKE = 3.0

# How far a splat is visible, in standard deviations; and the distance that views of an orbit keep from a scene, in near planes.
SEEN, CLEAR = 3, 2


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
        return views, f"{len(views)} views of a generated orbit{told} at {pixels} px ({reason})"
    if config.views == "given":
        return list(cameras), f"the {len(cameras)} given views"
    split = "test" if config.views == "test" else "train"
    views = [camera for camera in cameras if camera.split == split]
    if not views:
        raise SettingsError(f"there are no {split} views among the {len(cameras)} cameras; use the view policy 'given'")
    if config.views == "jittered":
        extra = jittered(with_company(views, viewpoints.orbit), config.extra_views, generator)
        return views + extra, f"{len(views)} train views and {len(extra)} around them"
    return views, f"the {len(views)} {split} views"


@announced("examining views")
def showing(views: Sequence[Camera], means: Tensor, near: float) -> list[Camera]:
    """The views that show one of the `means` [N, 3], farther than the near plane (world units)."""
    shown = [inside.any(1) for inside in _inside(views, means, near)]
    return list(compress(views, torch.cat(shown).tolist())) if shown else []


def _inside(views: Sequence[Camera], means: Tensor, near: float) -> Iterator[Tensor]:
    """Which `means` [N, 3] lie in the pictures of views, farther than the near plane: [V, N] bool for each batch of views."""
    for view in in_batches(views, means):
        yield view.in_picture(view.to_camera(means.detach()), near)


@announced("examining views")
def refuse_blind(views: Sequence[Camera], model: SplatModel, near: float, image_of: Callable[[Camera], Tensor], scale: float = 1.0) -> None:
    """Raise SettingsError if the views show nothing, or a speck: the cameras may be of another scene, or no renderer draws the splats, for example.

    `near`: the near plane, in world units; `image_of`: a view's image [h, w, 3]; `scale`: the one adapted to, since a zoom-in makes specks large.
    """
    some, means = evenly(views, LOOKED_AT), model.parameters()["means"]
    if not showing(some, means, near):  # a few of many cameras may see what is left of a scene that was cut down
        some = evenly(showing(views, means, near), LOOKED_AT) or some
    if any(_draws(view, model, near) for view in some):
        if small := too_small(views, model, near, min(LEAST_PIXELS, LEAST_SHARE * min(views[0].size)) / max(1.0, scale)):
            raise SettingsError(small)
        return
    if all(torch.equal(image, image[:1, :1].expand_as(image)) for image in map(image_of, some)):  # nor a splat whose center lies outside
        wrong = "the cameras seem to be of another scene, or in other coordinates; give those of this scene"
        if showing(some, means, near):
            wrong = "all splats in view have an opacity below 1/255 and are never drawn; the training or the export failed"
        elif showing(some, means, 0.0):
            wrong = f"all splats lie nearer than {near:g} units, where renderers of 3DGS draw none; {SCALE_UP}"
        raise SettingsError(f"none of the {len(views)} views shows a splat: {wrong}")


def _draws(view: Camera, model: SplatModel, near: float) -> bool:
    """Whether a row of the parameters that is opaque enough to be drawn lies in the view's picture, farther than the near plane."""
    inside = view.in_picture(view.to_camera(model.parameters()["means"].detach()), near)
    return bool(inside.any()) and bool((row_opacities(model, [view])[inside] >= MIN_ALPHA).any())


def refuse_large(views: Sequence[Camera], model: SplatModel, scale: float) -> None:
    """Raise SettingsError if the memory cannot hold the largest image that is adapted to."""
    largest = max(views, key=lambda camera: camera.width * camera.height).zoomed(scale)
    check_image(largest.width, largest.height, model.parameters()["means"].device)


def too_unlike(views: Sequence[Camera]) -> str:
    """That lenses differ so much that no file fits all of them, in a sentence; "" if they do not."""
    shortest, longest = (pick(math.sqrt(view.fx * view.fy) for view in views) for pick in (min, max))
    if longest <= UNLIKE * shortest:
        return ""
    where = f"focal lengths of the cameras are {shortest:.0f} to {longest:.0f} px, and what looks right through one does not through another"
    return f"{where}; adapt with the cameras of each lens on their own"


def too_near(views: Sequence[Camera], means: Tensor, near: float) -> str:
    """How many of the splats with these `means` [N, 3] in a view's picture are not drawn because they are too near, in a sentence; "" if few.

    `near`: the near plane, in world units.
    """
    some = evenly(views, LOOKED_AT)
    counts = [torch.cat([inside.sum(1) for inside in _inside(some, means, plane)]).tolist() for plane in (0.0, near)]
    lost = [1 - drawn / count for count, drawn in zip(*counts, strict=True) if count]
    if not lost or fmean(lost) <= TOO_MANY:
        return ""
    where = f"{fmean(lost):.0%} of the splats in a view's picture lie nearer than {near:g} units"
    return f"{where}, where renderers of 3DGS draw none; {SCALE_UP}"


def too_small(views: Sequence[Camera], model: SplatModel, near: float, least: float) -> str:
    """That no view shows the scene `least` px large, in a sentence; "" if one does. `near`: the near plane, in world units.

    A scene of no more splats than it has pixels is as small as it looks: in other units its splats would be smaller than pixels.
    """
    splats = model.gaussians(views[0]).detach()
    if len(splats) == 0:
        return ""
    center = splats.means.median(dim=0).values
    reach = (splats.means - center).norm(dim=1) + SEEN * splats.scales.abs().amax(1)
    width = 2 * float(reach.kthvalue(max(1, round(FRAMED * len(reach)))).values)
    middle = center.tolist()
    most = max(width * view.fx / max(math.dist(view.center.tolist(), middle), near) for view in views)
    if not most < least:
        return ""
    wrong = "the cameras seem to be in other units; give those of this scene"
    if max(view.fx for view in views) * width / least < width / 2 + CLEAR * near:
        wrong = f"renderers of 3DGS draw nothing nearer than {near:g} units; {SCALE_UP}"
    elif len(splats) <= most**2:
        return ""
    return f"the scene is {units(width, 2)} units wide, and no view shows it larger than {units(most, 2)} px: {wrong}"


def orbited(source: Path | None, orbit: Orbit) -> str:
    """What is said of views of an orbit: `ORBITED`, with the cameras.json that lies beside the file of the splats."""
    file, whole = unread_cameras(source), not orbit.nearest
    beside = f", such as {file}, if it is of this scene" if file else ""
    others = ("" if whole else VIEWED) + ("" if orbit.up else ", or say what is up (--up z, for one)")
    return f"{ORBITED.format(told=orbit.told(), seems='' if whole else CAPTURE)}{beside}{others}"


@announced("examining views")
def remarks(views: Sequence[Camera], model: SplatModel, near: float, *, orbit: bool) -> list[str]:
    """What is wrong with a scene in views that show something, in sentences. `near`: the near plane, in world units; `orbit`: they were generated."""
    least = LEAST_SHARE * min(views[0].size)
    least = least if orbit else min(LEAST_PIXELS, least)
    found = too_near(views, model.parameters()["means"], near), too_small(views, model, near, least)
    return [sentence for sentence in found if sentence]


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
