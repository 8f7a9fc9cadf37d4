"""The cameras, screen filters and settings as an array on the device, and transformations between world, camera and image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.render_settings import RenderSettings
from mipmap_plugin.splatting import filters
from mipmap_plugin.splatting.projection import slope_limits


class Shot(NamedTuple):
    """A view to be drawn."""

    camera: Camera
    effects: Effects
    ranks: Tensor | None = None  # [N] int32, front to back; sorts splats instead of their depths


# Indices into a view's numbers. They begin with the rotation, row by row, at 0.
EYE, FX, FY, CX, CY = tl.constexpr(9), tl.constexpr(12), tl.constexpr(13), tl.constexpr(14), tl.constexpr(15)
LEFT, RIGHT, TOP, BOTTOM = tl.constexpr(16), tl.constexpr(17), tl.constexpr(18), tl.constexpr(19)  # bounds of the slopes in the Jacobian
NEAR, EPS2D, MIN_ALPHA = tl.constexpr(20), tl.constexpr(21), tl.constexpr(23)
LEAST_COMPENSATION = tl.constexpr(22)  # squared
SH_DEGREE, MIN_TRANSMITTANCE = tl.constexpr(24), tl.constexpr(25)
RED, GREEN, BLUE = tl.constexpr(26), tl.constexpr(27), tl.constexpr(28)  # of the background
COMPENSATES = tl.constexpr(29)  # 1 or 0
WIDTH, HEIGHT, TILES_X, TILES_Y = tl.constexpr(30), tl.constexpr(31), tl.constexpr(32), tl.constexpr(33)  # px, and tiles
# Read where a view's settings are not the usual ones (`render_settings.RenderSettings`); what is off is 0, or infinite where it is a maximum.
MAX_ALPHA, FRAME, MAX_COLOR, COLOR_STEPS = tl.constexpr(34), tl.constexpr(35), tl.constexpr(36), tl.constexpr(37)  # three steps
W_END, LOG2_W_CUT = tl.constexpr(40), tl.constexpr(41)  # weights where splats have faded to 0, and where they are cut off, here -infinity if not
RADIAL, BOXED, ROOTED, LISTS_CULLED = tl.constexpr(42), tl.constexpr(43), tl.constexpr(44), tl.constexpr(45)  # 1 or 0
MIN_VARIANCE, MIN_CONTRIBUTION, LEAST_SPREAD = tl.constexpr(46), tl.constexpr(47), tl.constexpr(48)
MAX_VARIANCE, PICTURE_STEP, LEVEL_BELOW = tl.constexpr(49), tl.constexpr(50), tl.constexpr(51)
NUMBERS = tl.constexpr(52)  # of each view


def view_parameters(shots: Sequence[Shot], tile: int, gradients: bool, like: Tensor) -> Tensor:
    """The array [V, NUMBERS], on the device of `like`."""
    return torch.stack([_row(shot.camera, shot.effects, tile, gradients, like.dtype, like.device) for shot in shots])


@lru_cache(maxsize=4096)
def _row(camera: Camera, effects: Effects, tile: int, gradients: bool, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The numbers of a view, which the steps of an adaptation draw again and again. A copy of some hundred bytes that does not synchronize."""
    numbers = _of_camera(camera, effects, tile) + _of_settings(camera, effects.settings, gradients)
    return torch.tensor(numbers, dtype=dtype).to(device, non_blocking=True)


def _of_camera(camera: Camera, effects: Effects, tile: int) -> tuple[float, ...]:
    return (
        *camera.viewmat[:3, :3].flatten().tolist(),
        *camera.center.tolist(),
        *(camera.fx, camera.fy, camera.cx, camera.cy),
        *slope_limits(camera, effects.settings),
        *(effects.near_plane, effects.eps2d, filters.LEAST_COMPENSATION[effects.screen_filter] ** 2, effects.settings.min_alpha),
        *(effects.sh_degree, effects.settings.divisible[1]),
        *effects.background,
        float(filters.compensates(effects.screen_filter)),
        *(camera.width, camera.height, triton.cdiv(camera.width, tile), triton.cdiv(camera.height, tile)),
    )


def _of_settings(camera: Camera, settings: RenderSettings, gradients: bool) -> tuple[float, ...]:
    is_cut = settings.radius is not None and not settings.fades
    return (
        *(settings.divisible[0], settings.frame, math.inf if settings.max_color is None else settings.max_color),
        *(settings.color_steps or (0.0, 0.0, 0.0)),
        *(filters.w_end(settings), -(settings.radius**2) / 2 / math.log(2) if is_cut else -math.inf),
        *(float(settings.radial), float(settings.boxed), float(settings.rooted), float(gradients)),
        *(settings.min_variance, settings.min_contribution, settings.least_spread),
        *(settings.max_variance(camera.width, camera.height), settings.picture_step or 0.0, settings.level_below),
    )


@triton.jit
def rotation_row(view, which: tl.constexpr):
    return tl.load(view + 3 * which), tl.load(view + 3 * which + 1), tl.load(view + 3 * which + 2)


@triton.jit
def from_eye(view, x, y, z):
    """A point of the world relative to the eye, in world axes."""
    return x - tl.load(view + EYE), y - tl.load(view + EYE + 1), z - tl.load(view + EYE + 2)


@triton.jit
def in_camera(view, x, y, z):
    """A world vector in camera axes."""
    r0, r1, r2 = rotation_row(view, 0), rotation_row(view, 1), rotation_row(view, 2)
    return r0[0] * x + r0[1] * y + r0[2] * z, r1[0] * x + r1[1] * y + r1[2] * z, r2[0] * x + r2[1] * y + r2[2] * z


@triton.jit
def in_world(view, x, y, z):
    """A vector in camera axes, in world axes."""
    r0, r1, r2 = rotation_row(view, 0), rotation_row(view, 1), rotation_row(view, 2)
    return r0[0] * x + r1[0] * y + r2[0] * z, r0[1] * x + r1[1] * y + r2[1] * z, r0[2] * x + r1[2] * y + r2[2] * z


@triton.jit
def clamped_slopes(view, slope_x, slope_y):
    """The slopes at which the Jacobian is evaluated: the splat's own, clamped to the widened frustum."""
    u = tl.minimum(tl.maximum(slope_x, tl.load(view + LEFT)), tl.load(view + RIGHT))
    return u, tl.minimum(tl.maximum(slope_y, tl.load(view + TOP)), tl.load(view + BOTTOM))


@triton.jit
def image_axis(view, slope, per_unit, which: tl.constexpr):
    """px per world unit along the image's x or y: a row of the Jacobian of the projection, in world axes."""
    r, ahead = rotation_row(view, which), rotation_row(view, 2)
    return per_unit * (r[0] - slope * ahead[0]), per_unit * (r[1] - slope * ahead[1]), per_unit * (r[2] - slope * ahead[2])
