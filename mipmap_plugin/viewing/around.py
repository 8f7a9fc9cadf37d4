"""The views that a screen's picture is adapted to: around its own, and some of the scene's, none with more pixels than a screen has to draw."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from mipmap_plugin.adaptation.views import GOLDEN
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.scenes.trajectories import rotation_matrix
from mipmap_plugin.wrap import Wrapped

# Views around that of the screen, which is not among them and so can judge; and how far they are turned around what it looks at, radians.
NEAR, REACH = 24, math.radians(12)

# Views of the scene beside them, so that the file also suits what the screen does not show.
OWN = 48

# px at the new scale: each view is a part of the screen of at most this size. Together they cover it.
PIXELS = 120_000


def views_for_screen(base: Wrapped, screen: Camera, look_at: Tensor, scale: float) -> list[Camera]:
    """Views of the base's scale to adapt to for what `screen`, a camera of the new scale, shows around the point `look_at` [3]."""
    near = [part(turned(screen, look_at, number), number).zoomed(1 / scale) for number in range(NEAR)]
    given = base.views()
    train = [view for view in given if view.split == "train"] or given
    width, height = (max(1, math.ceil(side / scale)) for side in (screen.width, screen.height))
    own = [view.window(width, height) for view in evenly(train, OWN)]
    return [replace(view, name=f"screen_{number}", zoom=1.0, time=own[0].time, index=own[0].index) for number, view in enumerate(near)] + own


def turned(screen: Camera, look_at: Tensor, number: int) -> Camera:
    """A view beside the screen's: turned around `look_at`, farther with each number, on a spiral that fills a disc of radius `REACH`."""
    radius, angle = REACH * math.sqrt((number + 1) / NEAR), 2 * math.pi * GOLDEN * number
    rotation = screen.viewmat[:3, :3].T
    axis = rotation @ torch.tensor([radius * math.cos(angle), radius * math.sin(angle), 0.0], dtype=torch.float64)
    turn = rotation_matrix(axis)
    center = look_at + turn @ (screen.center - look_at)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = (turn @ rotation).T
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return screen.looking_from(viewmat, screen.name)


def part(view: Camera, number: int) -> Camera:
    """A part of a view of at most `PIXELS` px, somewhere else for each number."""
    fraction = min(1.0, math.sqrt(PIXELS / (view.width * view.height)))
    width, height = (max(1, int(fraction * side)) for side in (view.width, view.height))
    left = round((view.width - width) * (GOLDEN * number % 1))
    top = round((view.height - height) * (number / max(1, NEAR - 1)))
    return replace(view, width=width, height=height, cx=view.cx - left, cy=view.cy - top)
