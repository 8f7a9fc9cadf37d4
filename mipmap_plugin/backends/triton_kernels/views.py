"""The cameras and screen filters as an array on the device, and transformations between world, camera and image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import torch
import triton
import triton.language as tl
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.render_settings import FRUSTUM_MARGIN
from mipmap_plugin.splatting import filters

# Indices into a view's numbers. They begin with the rotation, row by row, at 0.
EYE, FX, FY, CX, CY = tl.constexpr(9), tl.constexpr(12), tl.constexpr(13), tl.constexpr(14), tl.constexpr(15)
LEFT, RIGHT, TOP, BOTTOM = tl.constexpr(16), tl.constexpr(17), tl.constexpr(18), tl.constexpr(19)  # bounds of the slopes in the Jacobian
NEAR, EPS2D, MIN_ALPHA = tl.constexpr(20), tl.constexpr(21), tl.constexpr(23)
LEAST_COMPENSATION = tl.constexpr(22)  # squared
LOG2_MIN_ALPHA, MIN_TRANSMITTANCE = tl.constexpr(24), tl.constexpr(25)
RED, GREEN, BLUE = tl.constexpr(26), tl.constexpr(27), tl.constexpr(28)  # of the background
COMPENSATES = tl.constexpr(29)  # 1 or 0
WIDTH, HEIGHT, TILES_X, TILES_Y = tl.constexpr(30), tl.constexpr(31), tl.constexpr(32), tl.constexpr(33)  # px, and tiles
NUMBERS = tl.constexpr(34)  # of each view


def view_parameters(shots: Sequence[tuple[Camera, Effects]], tile: int, like: Tensor) -> Tensor:
    """The array [V, NUMBERS], on the device of `like`. A copy of some hundred bytes that does not synchronize."""
    return torch.tensor([_numbers(*shot, tile) for shot in shots], dtype=like.dtype).to(like.device, non_blocking=True)


@lru_cache(maxsize=1024)
def _numbers(camera: Camera, effects: Effects, tile: int) -> tuple[float, ...]:
    margin_x, margin_y = FRUSTUM_MARGIN * camera.width / camera.fx / 2, FRUSTUM_MARGIN * camera.height / camera.fy / 2
    return (
        *camera.viewmat[:3, :3].flatten().tolist(),
        *camera.center.tolist(),
        *(camera.fx, camera.fy, camera.cx, camera.cy),
        *(-camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x),
        *(-camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y),
        *(effects.near_plane, effects.eps2d, filters.LEAST_COMPENSATION[effects.screen_filter] ** 2, effects.settings.min_alpha),
        *(math.log2(effects.settings.min_alpha), effects.settings.min_transmittance),
        *effects.background,
        float(filters.compensates(effects.screen_filter)),
        *(camera.width, camera.height, triton.cdiv(camera.width, tile), triton.cdiv(camera.height, tile)),
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
