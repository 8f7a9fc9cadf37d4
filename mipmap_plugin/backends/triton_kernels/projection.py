"""Projection: from splats in the world to records, depths, and boxes of the tiles that each may touch. One splat per lane."""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin.backends.triton_kernels import culling, views
from mipmap_plugin.backends.triton_kernels.harmonics import color
from mipmap_plugin.backends.triton_kernels.records import HALF_LOG2_E, LN_2, RECORD, end_of, store_six
from mipmap_plugin.backends.triton_kernels.rounding import round_to
from mipmap_plugin.backends.triton_kernels.shapes import from_axes, from_covariance, load_quat
from mipmap_plugin.backends.triton_kernels.vectors import LARGEST, finite, load3
from mipmap_plugin.backends.triton_kernels.views import clamped_slopes, from_eye, image_axis, in_camera
from mipmap_plugin.splatting import filters

NEAR, EPS2D, MIN_ALPHA, W_END, SH_DEGREE = views.NEAR, views.EPS2D, views.MIN_ALPHA, views.W_END, views.SH_DEGREE
COMPENSATES, LEAST_COMPENSATION = views.COMPENSATES, views.LEAST_COMPENSATION
FX, FY, CX, CY = views.FX, views.FY, views.CX, views.CY
FRAME, RADIAL, MAX_COLOR, COLOR_STEPS, LISTS_CULLED = views.FRAME, views.RADIAL, views.MAX_COLOR, views.COLOR_STEPS, views.LISTS_CULLED
WIDTH, HEIGHT, TILES_X, TILES_Y, NUMBERS = views.WIDTH, views.HEIGHT, views.TILES_X, views.TILES_Y, views.NUMBERS
THINNEST = tl.constexpr(filters.THINNEST)


@triton.jit
def relative_position(view, means, at, mask):
    """Positions of the splats `at` [B] relative to the eye, in world axes and in camera axes, and the depth clamped to the near plane."""
    world = from_eye(view, *load3(means + 3 * at, mask))
    eye = in_camera(view, *world)
    return world, eye, tl.maximum(eye[2], tl.load(view + NEAR))


@triton.jit
def load_scale(scales, at, mask, RAW: tl.constexpr):
    """The standard deviations of the splats `at` [B]; raw ones are their logarithms."""
    a, b, c = load3(scales + 3 * at, mask)
    if RAW:
        a, b, c = tl.exp(a), tl.exp(b), tl.exp(c)
    return a, b, c


@triton.jit
def load_opacity(opacities, at, mask, RAW: tl.constexpr):
    """Opacities; raw ones are their logits."""
    opacity = tl.load(opacities + at, mask, 0.0)
    if RAW:
        opacity = 1 / (1 + tl.exp(-opacity))
    return opacity


@triton.jit
def image_covariance(view, eye, safe, quats, scales, covariances, at, mask, HAS_COVARIANCES: tl.constexpr, RAW: tl.constexpr):
    """xx, xy, yy, det on the image, before any screen filter."""
    u, v = clamped_slopes(view, eye[0] / safe, eye[1] / safe)
    t = image_axis(view, u, tl.load(view + FX) / safe, 0)
    r = image_axis(view, v, tl.load(view + FY) / safe, 1)
    if HAS_COVARIANCES:
        xx, xy, yy, det = from_covariance(covariances + 9 * at, mask, t, r)
    else:
        xx, xy, yy, det = from_axes(load_quat(quats + 4 * at, mask), load_scale(scales, at, mask, RAW), t, r)
    return xx, xy, yy, det


@triton.jit
def direction(world):
    """The unit vector from the eye to a splat, and 1 / distance; for a splat exactly at the eye an arbitrary unit vector and 0."""
    squared = world[0] * world[0] + world[1] * world[1] + world[2] * world[2]
    per = tl.where(squared == 0, 0.0, 1 / tl.sqrt(tl.where(squared == 0, 1.0, squared)))
    return world[0] * per, world[1] * per, tl.where(squared == 0, 1.0, world[2] * per), per


@triton.jit
def by_channel(at, mask):
    """For the splats `at` [B] their numbers, their channels and the mask in a lane per channel [B, 4], of which the fourth is none."""
    channel = tl.arange(0, 4)[None, :]
    return at[:, None] + 0 * channel, channel, mask[:, None] & (channel < 3)


@triton.jit
def bounds(center, extent, tiles, TILE: tl.constexpr):
    """The first tile that [center ± extent] px reaches, and their number; as clamped floats, because integers could overflow."""
    first = tl.minimum(tl.maximum(tl.floor((center - extent) / TILE), 0.0), tiles)
    last = tl.minimum(tl.maximum(tl.floor((center + extent) / TILE) + 1, 0.0), tiles)
    return first, tl.maximum(last - first, 0.0)


@triton.jit
def reshaped(view, xx, xy, yy, det, opacity):
    """Dilated shapes as they are drawn, stretched and limited, and which splats are not culled. opacity: before any compensation."""
    kept = culling.is_drawn(view, xx, xy, yy, det, opacity)
    xx, xy, yy, det = culling.stretched(view, xx, xy, yy, det, kept)
    xx, xy, yy, det = culling.limited(view, xx, xy, yy, det)
    return xx, xy, yy, det, kept


@triton.jit
def in_frame(view, x, y):
    """Whether centers lie where the view draws splats."""
    aside = tl.maximum(tl.abs(x * (2 / tl.load(view + WIDTH)) - 1), tl.abs(y * (2 / tl.load(view + HEIGHT)) - 1))
    return aside <= tl.load(view + FRAME)


@triton.jit
def viewed_color(view, value, channel):
    """Colors [B, channels], limited and rounded."""
    step = tl.load(view + COLOR_STEPS + channel, channel < 3, 0.0)
    return round_to(tl.minimum(value, tl.load(view + MAX_COLOR)), step)


@triton.jit(do_not_specialize=["count"])
def project_kernel(
    means, quats, scales, covariances, opacities, sh, shots, records, depths, boxes, count,
    HAS_COVARIANCES: tl.constexpr, RAW: tl.constexpr, DEGREE: tl.constexpr, BANDS: tl.constexpr, VIEWER: tl.constexpr, TILE: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Project `count` splats to the view of the program's second number."""
    view = shots + tl.program_id(1) * NUMBERS
    at = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    inside = at < count
    row = tl.program_id(1).to(tl.int64) * count + at
    _world, eye, safe = relative_position(view, means, at, inside)
    ahead = inside & (eye[2] > tl.load(view + NEAR))
    xx, xy, yy, det = image_covariance(view, eye, safe, quats, scales, covariances, at, ahead, HAS_COVARIANCES, RAW)
    eps2d = tl.load(view + EPS2D)
    det_blur = det + eps2d * (xx + yy) + eps2d * eps2d
    compensation = tl.sqrt(tl.maximum(det / det_blur, tl.load(view + LEAST_COMPENSATION)))
    opacity = load_opacity(opacities, at, ahead, RAW)
    xx, yy, kept = xx + eps2d, yy + eps2d, inside
    if VIEWER:
        xx, xy, yy, det_blur, kept = reshaped(view, xx, xy, yy, det_blur, opacity)
    opacity *= tl.where(tl.load(view + COMPENSATES) > 0, compensation, 1.0)
    x = eye[0] / safe * tl.load(view + FX) + tl.load(view + CX)
    y = eye[1] / safe * tl.load(view + FY) + tl.load(view + CY)
    all_finite = finite(x) & finite(y) & finite(xx) & finite(xy) & finite(yy) & finite(det_blur) & finite(opacity)
    shear, across, along = xy / yy, det_blur / yy, (-1 / yy) * HALF_LOG2_E
    drawn = ahead & all_finite & (opacity >= tl.load(view + MIN_ALPHA)) & (across > THINNEST)
    if VIEWER:
        drawn &= in_frame(view, x, y) & tl.where(tl.load(view + LISTS_CULLED) > 0, inside, kept)
        along, opacity = tl.where(kept, along, -along), opacity / (1 - tl.load(view + W_END))
    log2_opacity = tl.log2(opacity)
    reach = tl.sqrt(end_of(view, log2_opacity) * (2 * LN_2))
    reach_x, reach_y = reach * tl.sqrt(xx), reach * tl.sqrt(yy)
    drawn &= (x + reach_x > 0) & (x - reach_x < tl.load(view + WIDTH)) & (y + reach_y > 0) & (y - reach_y < tl.load(view + HEIGHT))
    rows, channel, shown = by_channel(at, drawn)
    dx, dy, dz, _ = direction(from_eye(view, *load3(means + 3 * rows, shown)))
    value = color(sh + rows * (3 * BANDS) + channel, dx, dy, dz, tl.load(view + SH_DEGREE), shown, DEGREE)
    drawn &= tl.min(finite(value).to(tl.int32), axis=1) > 0
    value = tl.maximum(value + 0.5, 0.0)
    if VIEWER:
        value = viewed_color(view, value, channel)
    tl.store(records + (tl.program_id(1).to(tl.int64) * count + rows) * RECORD + 6 + channel, value, shown)
    store_six(records + row * RECORD, x, y, along, shear, (-1 / across) * HALF_LOG2_E, log2_opacity, drawn)
    depth = eye[2]
    if VIEWER:
        distance = tl.minimum(tl.sqrt(eye[0] * eye[0] + eye[1] * eye[1] + eye[2] * eye[2]), LARGEST)  # infinity is for what is not drawn
        depth = tl.where(tl.load(view + RADIAL) > 0, distance, depth)
    tl.store(depths + row, tl.where(drawn, depth, float("inf")), inside)
    first_x, wide_x = bounds(x, reach_x, tl.load(view + TILES_X), TILE)
    first_y, wide_y = bounds(y, reach_y, tl.load(view + TILES_Y), TILE)
    box = boxes + 4 * row
    tl.store(box, tl.where(drawn, first_x, 0.0).to(tl.int32), inside)
    tl.store(box + 1, tl.where(drawn, first_y, 0.0).to(tl.int32), inside)
    tl.store(box + 2, tl.where(drawn, wide_x, 0.0).to(tl.int32), inside)
    tl.store(box + 3, tl.where(drawn, wide_x * wide_y, 0.0).to(tl.int32), inside)
