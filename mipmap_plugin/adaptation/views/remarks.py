"""What is to be known of a scene in its views, in sentences: it is a speck in them, too near, or no single file suits all of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from mipmap_plugin.adaptation.views.shown import SAMPLES, inside_pictures
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.effects import Effects
from mipmap_plugin.formats.splat_transform import is_spz
from mipmap_plugin.models.base import SplatModel, means_at
from mipmap_plugin.models.health import extent_of, units
from mipmap_plugin.progress import announced
from mipmap_plugin.scenes import unread_cameras
from mipmap_plugin.scenes.orbits import FRAMED, Orbit
from mipmap_plugin.scenes.photographed import quantile
from mipmap_plugin.splatting.packing import in_two_steps, packed

# Views that are looked at to see whether they show anything; and the mean fraction of their splats in front of the near plane that is worth a word.
# Floaters lie close to cameras, but captures in usual units have no splats there; made ten times smaller they have 2 %, twenty times smaller half.
LOOKED_AT, TOO_MANY = 16, 0.05

# A scene that no view shows larger than so many px, or than this fraction of a picture's shorter side, is too small to adapt. In views of an orbit it
# fills nearly all of a picture, unless it has such small units that the near plane keeps cameras farther away than a user's.
LEAST_PIXELS, LEAST_SHARE = 16, 0.25

# What fills fewer cells than a line of ACROSS of them, though it has CROWDED times as many splats, is a few things far apart. 95 objects,
# captures and tiles of these fill 1,000 cells at least, and two rooms at a distance of a kilometer 14.
ACROSS, CROWDED = 64, 16

# What to do about a scene in units so small that the near plane hides it.
SCALE_UP = "scale the scene up, with its cameras if it has any"

# What is said where there are no cameras: with those of an object all is well, but those of a capture are a guess, which may cost 10 dB and more.
ORBITED = (
    "no cameras are known: views of a generated orbit are adapted to, {told}, and all dB are of such{seems}; give the scene's cameras (--cameras)"
)
CAPTURE = "; this seems to be a capture, and from where it was photographed is a guess: seen from there it may look worse than its base"
VIEWED = ", or adapt for what you look at (mipmap-plugin view)"

# Its own converter, too, keeps the axes of a PLY, mostly with y down (nianticlabs/spz, issue 84), and no file says which axes it has. splat-transform
# and Spark take what is stored.
OF_SPZ = "; an .spz is meant to have y up: if this one has, say so (--up y)"

# Lenses whose focal lengths (px) have a larger ratio need different files, as scales of that ratio do. A ratio of 5 costs a capture 10 of 12 dB.
UNLIKE = 3.0

# What to do about lenses that no single file fits.
EACH_LENS = "adapt with the cameras of each lens on their own"

# Views and splats by which it is measured how far a viewer that rounds positions displaces splats, and the fraction of displaced ones worth a word.
ROUNDED_IN, ROUNDED, DISPLACED = 4, 1 << 14, 0.5

# How far a splat is visible, in standard deviations; and the distance that views of an orbit keep from a scene, in near planes.
SEEN, CLEAR = 3, 2


def too_unlike(views: Sequence[Camera]) -> str:
    """That lenses differ so much that no file fits all of them, in a sentence; "" if they do not."""
    shortest, longest = (pick(map(focal_length, views)) for pick in (min, max))
    if longest <= UNLIKE * shortest:
        return ""
    where = f"focal lengths of the cameras are {shortest:.0f} to {longest:.0f} px, and what looks right through one does not through another"
    return f"{where}; {EACH_LENS}"


def too_far_out(model: SplatModel, views: Sequence[Camera], targets: Mapping[str, Effects]) -> str:
    """That a viewer which keeps positions in 16 bits displaces most splats by more than their size, or loses them, in a sentence; "" if none does."""
    for viewer, effects in targets.items():
        positions = effects.settings.packing and in_two_steps(effects.settings.packing)[1]
        if not positions:
            continue
        splats = model.gaussians(views[0]).detach()
        splats = splats[:: max(1, len(splats) // ROUNDED)]
        moved = [(packed(splats, view, positions).means - splats.means).abs().amax(1) for view in evenly(views, ROUNDED_IN)]
        share = float((torch.stack(moved) > splats.scales.abs().amax(1)).double().mean())
        if share > DISPLACED:
            where = f"{viewer} keeps positions in 16 bits, by which {share:.0%} of the splats are off by more than their size, or lost"
            return f"{where}; move the scene to the world's origin, with its cameras, or give another viewer"
    return ""


def focal_length(view: Camera) -> float:
    """The focal length of both axes, px, of the lens itself: a view of a band lies at a zoom of its own."""
    return math.sqrt(view.fx * view.fy) * view.base_zoom / view.zoom


def too_near(views: Sequence[Camera], means: Tensor, near: float) -> str:
    """How many of the splats with these `means` [N, 3] in a view's picture are not drawn because they are too near, in a sentence; "" if few.

    Of many splats some are looked at. `near`: the near plane, in world units.
    """
    some, means = evenly(views, LOOKED_AT), means[:: 1 + len(means) // SAMPLES[-1]]
    counts = [torch.cat([inside.sum(1) for inside in inside_pictures(some, means, plane)]).tolist() for plane in (0.0, near)]
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
    width = 2 * float(quantile(reach, FRAMED))
    middle = center.tolist()
    away = [math.dist(view.center.tolist(), middle) for view in views]
    most = max(width * view.fx / max(distance, near) for view, distance in zip(views, away, strict=True))
    if not most < least:
        return ""
    wrong = "the cameras seem to be in other units; give those of this scene"
    wanted, allowed = max(view.fx for view in views) * width / least, width / 2 + CLEAR * near  # distances at which it is large, and is drawn whole
    if width / 2 < wanted < allowed and min(away) < 2 * allowed:
        wrong = f"renderers of 3DGS draw nothing nearer than {near:g} units; {SCALE_UP}"
    elif len(splats) <= most**2:
        return ""
    return f"the scene is {units(width, 2)} units wide, and no view shows it larger than {units(most, 2)} px: {wrong}"


def in_small_units(model: SplatModel, near: float) -> str:
    """That a scene is so small that it is drawn with a nearer near plane, at `near`, than in its training, in a sentence; "" if it is not."""
    usual = model.trained.near_plane
    if near >= usual:
        return ""
    wide = f"the scene is {units(extent_of(model.parameters()['means'].detach()), 2)} units wide, so that splats nearer than"
    return f"{wide} {usual:g} units are drawn here, too; renderers of 3DGS draw none of these: if the file is for one, {SCALE_UP}"


def hints(views: Sequence[Camera], model: SplatModel, near: float) -> list[str]:
    """What is to be known of views and of units, in sentences, which makes no scene doubtful. `near`: the near plane, in world units."""
    return [sentence for sentence in (too_unlike(views), in_small_units(model, near)) if sentence]


def far_apart(means: Tensor) -> str:
    """That the splats at `means` [N, 3] are a few things with nothing between them, in a sentence; "" if not. An orbit shows each as a speck."""
    means = means[means.isfinite().all(dim=1)][:: 1 + len(means) // SAMPLES[-1]]
    if len(means) <= CROWDED * ACROSS:
        return ""
    away = (means - means.median(dim=0).values).norm(dim=1)
    radius = float(quantile(away, FRAMED))
    if not radius or len((means * (ACROSS / radius)).floor().unique(dim=0)) >= ACROSS:
        return ""
    where = f"the splats are a few things, {units(radius, 2)} units apart, which generated views show as specks"
    return f"{where}: seen from nearer the file may look worse than its base; give the scene's cameras (--cameras), or a file of each thing"


def orbited(source: Path | None, orbit: Orbit) -> str:
    """What is said of views of an orbit: `ORBITED`, with the cameras.json that lies beside the file of the splats."""
    file, whole = unread_cameras(source), not orbit.nearest
    beside = f", such as {file}, if it is of this scene" if file else ""
    others = "" if whole else VIEWED
    if not (orbit.up or orbit.seen):
        others += ", or say what is up (--up z, for one)"
    elif not (orbit.said or orbit.seen) and source is not None and is_spz(source):
        others += OF_SPZ
    return f"{ORBITED.format(told=orbit.told(), seems='' if whole else CAPTURE)}{beside}{others}"


@announced("examining views")
def remarks(views: Sequence[Camera], model: SplatModel, near: float, *, orbit: bool) -> list[str]:
    """What is wrong with a scene in views that show something, in sentences. `near`: the near plane, in world units; `orbit`: they were generated."""
    least = LEAST_SHARE * min(views[0].size)
    least = least if orbit else min(LEAST_PIXELS, least)
    means = means_at(model, views[0])
    found = too_near(views, means, near), too_small(views, model, near, least), far_apart(means) if orbit else ""
    return [sentence for sentence in found if sentence]
