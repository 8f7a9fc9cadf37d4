"""The views that a screen's picture is adapted to: around its own, and some of the scene's, none with more pixels than a screen has to draw."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera, evenly, viewmat_of
from mipmap_plugin.models.base import means_at
from mipmap_plugin.scenes.photographed import GOLDEN
from mipmap_plugin.scenes.trajectories import rotation_matrix
from mipmap_plugin.viewing.screen import inside
from mipmap_plugin.wrap import Wrapped

# Views around that of the screen, which is not among them and so can judge; and how far they are turned around what it looks at, radians.
NEAR, REACH = 16, math.radians(12)

# Views of the scene beside them, so that the file also suits what the screen does not show.
OWN = 32

# px at the new scale, and at the base's: each view is a part of at most this size, so that a step takes a fraction of a second.
PIXELS, BASE_PIXELS = 120_000, 400_000


def views_for_screen(base: Wrapped, screen: Camera, look_at: Tensor, scale: float) -> list[Camera]:
    """Views of the base's scale to adapt to for what `screen`, a camera of the new scale, shows around the point `look_at` [3]."""
    means, plane = means_at(base.model, screen), base.effects().near_plane
    near = [part(turned(screen, look_at, number), means, plane, scale, number).zoomed(1 / scale) for number in range(NEAR)]
    given = base.cameras or base.viewpoints.best(evenly(base.views(), OWN))
    train = [view for view in given if view.split == "train"] or given
    own = [middle(view, PIXELS / scale**2) for view in evenly(train, OWN)]
    return [replace(view, name=f"screen_{number}", base_zoom=view.zoom, index=own[0].index) for number, view in enumerate(near)] + own


def turned(screen: Camera, look_at: Tensor, number: int) -> Camera:
    """A view beside the screen's: turned around `look_at`, farther with each number, on a spiral that fills a disc of radius `REACH`."""
    radius, angle = REACH * math.sqrt((number + 1) / NEAR), 2 * math.pi * GOLDEN * number
    rotation = screen.viewmat[:3, :3].T
    axis = rotation @ torch.tensor([radius * math.cos(angle), radius * math.sin(angle), 0.0], dtype=torch.float64)
    turn = rotation_matrix(axis)
    center = look_at + turn @ (screen.center - look_at)
    return screen.looking_from(viewmat_of(turn @ rotation, center), screen.name)


def middle(view: Camera, pixels: float) -> Camera:
    """The middle of a view, of at most so many px."""
    fraction = min(1.0, math.sqrt(pixels / (view.width * view.height)))
    return view.window(max(1, int(fraction * view.width)), max(1, int(fraction * view.height)))


def part(view: Camera, means: Tensor, near: float, scale: float, number: int) -> Camera:
    """A part of a view of the new scale around one of the splats in it, another for each number.

    `means`: [N, 3], the centers of all splats; `near`: the near plane, both in world units.
    """
    fraction = min(1.0, math.sqrt(min(PIXELS, BASE_PIXELS * scale**2) / (view.width * view.height)))
    width, height = (max(1, int(fraction * side)) for side in (view.width, view.height))
    seen = inside(means, view, near).nonzero()[:, 0]
    x, y = view.width / 2, view.height / 2
    if len(seen):
        place = view.to_camera(means[seen[int(len(seen) * (GOLDEN * number % 1))]][None])[0].tolist()
        x, y = view.fx * place[0] / place[2] + view.cx, view.fy * place[1] / place[2] + view.cy
    left, top = min(max(0, round(x - width / 2)), view.width - width), min(max(0, round(y - height / 2)), view.height - height)
    return replace(view, width=width, height=height, cx=view.cx - left, cy=view.cy - top)
