"""Splits the large splats that a viewer leaves out of pictures in which training drew them.

Viewers leave out a splat whose center lies too far beside the picture (`RenderSettings.frame`), and shorten one that is longer than `max_half_axis`.
In a capture a few dozen splats, of its lawn or sky, lose most by that: 50 of 38,347 in flowers, which have 20 dB in Spark as they are, and 26 with
these in parts. A splat is replaced by three along its longest axis until the viewer leaves out hardly anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.adaptation.start.blend_weights import weighed
from mipmap_plugin.adaptation.start.clock import start_clock
from mipmap_plugin.adaptation.start.problem import StartProblem
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.contract import rebuild
from mipmap_plugin.splatting.rotations import rotations

# What a viewer leaves out is looked for in so many views, drawn at this fraction of their size.
LOOKED_AT, SIZE = 24, 0.5

# The part of a picture, on average over the views, that a splat may lose, and all that lose more may lose together.
LEAST_LOST, ENOUGH = 1e-4, 3e-3

# A splat is split at most so often: six times makes its longest axis a twentieth as long.
ROUNDS = 6

# There are at most so many times as many splats as before; those that lose most are split first. With 1.25 an object under a sky has no dB more.
MOST = 1.1

# In a time budget looking for such splats may take so much of a start's time (`START_SHARE`), before that begins.
PART = 1 / 4

# The three parts of a splat: their longest axis and the distance of the outer ones from the middle, in its standard deviations.
SHORTER, APART = 0.6, 0.9


@torch.no_grad()
def in_parts(problem: StartProblem) -> StartProblem:
    """The same problem with large splats of the base in parts, where the target leaves them out and it looks better by that.

    Not without the closed form (`paper`), nor where blend weights cannot be measured, and only as far as a time budget allows.
    """
    cut = _cuts(problem)
    if cut is None or not (problem.has_blend_weights and problem.config.closed_form):
        return problem
    whole, parts, views = problem.base(), problem.base(), evenly(problem.views, LOOKED_AT)
    splats = whole.gaussians(views[0]).detach()
    if any(problem.backend.lacking(Needs.of(splats, effects, gradients=True)) for effects in cut):
        return problem
    with problem.phase("splitting"):
        rebuild(parts, lambda splats: _split(splats, views, problem, cut))
    if len(parts.parameters()["means"]) == len(splats) or problem.quality(parts).visible <= problem.quality(whole).visible:
        return problem
    return replace(problem, base=getattr(parts, "shared", parts.copy), name="the base, its largest splats in parts")


def thirds(splats: Gaussians) -> Gaussians:
    """Three splats for each of N, [3N]: the middle ones, and those at either end of its longest axis.

    All three together are nearly as opaque as the splat everywhere, within 0.02 up to an opacity of 0.4 and within 0.06 up to 1. Their opacities over
    its own were found by least squares along the axis, and rise nearly linearly with it.
    """
    longest, axis = splats.scales.max(dim=1)
    along = torch.take_along_dim(rotations(splats.quats), axis[:, None, None], dim=2)[:, :, 0]
    offset = APART * longest[:, None] * along
    scales = splats.scales.scatter(1, axis[:, None], SHORTER * longest[:, None])
    middle, side = ((low + rise * splats.opacities) * splats.opacities for low, rise in ((0.69, 0.31), (0.46, 0.04)))
    parts = [(splats.means, middle), (splats.means + offset, side), (splats.means - offset, side)]
    first, *others = (replace(splats, means=means, scales=scales, opacities=opacities) for means, opacities in parts)
    for other in others:
        first = first.joined(other)
    return first


def _cuts(problem: StartProblem) -> tuple[Effects, Effects] | None:
    """How the base is drawn whole, and without what the target leaves out of large splats; None where the base's renderer leaves that out, too."""
    settings, target = problem.base_effects.settings, problem.target.settings
    whole = replace(settings, radius=target.radius)
    cut = replace(whole, frame=target.frame, max_half_axis=target.max_half_axis / problem.scale, fits_picture=target.fits_picture)
    return None if cut == whole else (replace(problem.base_effects, settings=whole), replace(problem.base_effects, settings=cut))


def _split(splats: Gaussians, views: Sequence[Camera], problem: StartProblem, cut: tuple[Effects, Effects]) -> Gaussians:
    """The splats, those that lose much in parts."""
    most, allowed = int(MOST * len(splats)), problem.config.most_splats
    if allowed is not None and len(splats) <= allowed:  # or they are merged after all
        most = min(most, allowed)
    picture = sum(view.width * view.height for view in views) / len(views)
    clock = start_clock(problem)
    if clock.limited:
        with clock.timing("look", 1 / len(views)):
            _lost(splats, views[:1], problem, cut)
    for _ in range(ROUNDS):
        if not clock.allows("look", part=PART):
            break
        with clock.timing("look"):
            lost = _lost(splats, views, problem, cut) / picture
        much = lost > LEAST_LOST
        rows = lost.topk(min((most - len(splats)) // 2, int(much.sum()))).indices
        if len(rows) == 0 or lost[much].sum() < ENOUGH:
            break
        stays = torch.ones_like(lost, dtype=torch.bool).index_fill(0, rows, False)
        splats = splats[stays].joined(thirds(splats[rows]))
    return splats


def _lost(splats: Gaussians, views: Sequence[Camera], problem: StartProblem, cut: tuple[Effects, Effects]) -> Tensor:
    """What each splat loses of its blend weight, [N] in px of a view."""
    whole, left = (weighed(splats, views, [0] * len(views), problem.backend, effects, SIZE)[0].sum(1) for effects in cut)
    return whole - left
