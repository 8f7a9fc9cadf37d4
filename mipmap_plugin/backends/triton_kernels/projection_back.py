"""Backward pass of projection: from the gradients of the records to those of the splats. One splat per lane."""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin.backends.triton_kernels import culling, views
from mipmap_plugin.backends.triton_kernels.projection import direction, image_covariance, load_opacity, load_scale, relative_position
from mipmap_plugin.backends.triton_kernels.records import HALF_LOG2_E, LN_2, RECORD
from mipmap_plugin.backends.triton_kernels.shapes import from_axes_back, from_covariance_back, load_quat
from mipmap_plugin.backends.triton_kernels.vectors import add, add3, dot, load3
from mipmap_plugin.backends.triton_kernels.views import clamped_slopes, image_axis, in_world, rotation_row

EPS2D, COMPENSATES, LEAST_COMPENSATION = views.EPS2D, views.COMPENSATES, views.LEAST_COMPENSATION
FX, FY, NUMBERS = views.FX, views.FY, views.NUMBERS


@triton.jit
def record_back(xy, yy, det, d_along, d_shear, d_across):
    """Gradients of xy, yy and det as drawn from those of a record."""
    across = det / yy
    d_width = d_across * HALF_LOG2_E / across / across  # the square of a small number would be 0
    return d_shear / yy, (d_along * HALF_LOG2_E / yy - d_shear * xy / yy - d_width * across) / yy, d_width / yy


@triton.jit
def reshaped_back(view, opacity, xx, xy, yy, det, d_along, d_shear, d_across, d_log2_opacity):
    """Gradients of the dilated shape, of the logarithm of the opacity as drawn, and of the opacity itself, from those of a record."""
    kept = culling.is_drawn(view, xx, xy, yy, det, opacity)
    sxx, sxy, syy, sdet = culling.stretched(view, xx, xy, yy, det, kept)
    _lxx, lxy, lyy, ldet = culling.limited(view, sxx, sxy, syy, sdet)
    d_xy, d_yy, d_det = record_back(lxy, lyy, ldet, d_along, d_shear, d_across)
    d_xx, d_xy, d_yy, d_det = culling.limited_back(view, sxx, sxy, syy, sdet, tl.zeros_like(d_yy), d_xy, d_yy, d_det)
    d_xx, d_xy, d_yy, d_det = culling.stretched_back(view, xx, xy, yy, kept, d_xx, d_xy, d_yy, d_det)
    g_xx, g_xy, g_yy, g_det, d_opacity = culling.gate_back(view, xx, xy, yy, det, opacity, d_log2_opacity / LN_2)
    return d_xx + g_xx, d_xy + g_xy, d_yy + g_yy, d_det + g_det, tl.where(kept, d_log2_opacity, 0.0), d_opacity


@triton.jit
def filter_back(view, opacity, xx, xy, yy, det, d_along, d_shear, d_across, d_log2_opacity, VIEWER: tl.constexpr):
    """Gradients of xx, xy, yy and det before the screen filter, and of the opacity, from those of a record."""
    eps2d = tl.load(view + EPS2D)
    det_blur = det + eps2d * (xx + yy) + eps2d * eps2d
    if VIEWER:
        d_xx, d_xy, d_yy, d_det_blur, d_log2_opacity, d_opacity = reshaped_back(
            view, opacity, xx + eps2d, xy, yy + eps2d, det_blur, d_along, d_shear, d_across, d_log2_opacity
        )
    else:
        d_xy, d_yy, d_det_blur = record_back(xy, yy + eps2d, det_blur, d_along, d_shear, d_across)
        d_xx, d_opacity = tl.zeros_like(d_yy), tl.zeros_like(d_yy)
    ratio = det / det_blur
    d_ratio = tl.where(ratio < tl.load(view + LEAST_COMPENSATION), 0.0, d_log2_opacity / (ratio * (2 * LN_2)))
    d_ratio = tl.where(tl.load(view + COMPENSATES) > 0, d_ratio, 0.0)
    d_det, d_det_blur = d_ratio / det_blur, d_det_blur - d_ratio * ratio / det_blur
    d_opacity += d_log2_opacity / (opacity * LN_2)
    return d_xx + d_det_blur * eps2d, d_xy, d_yy + d_det_blur * eps2d, d_det + d_det_blur, d_opacity


@triton.jit
def relative_position_back(view, eye, safe, u, v, dt, dr, d_x, d_y):
    """Gradient of the position in the world from those of the image axes and of the center on the image."""
    right, down, ahead = rotation_row(view, 0), rotation_row(view, 1), rotation_row(view, 2)
    per_x, per_y = tl.load(view + FX) / safe, tl.load(view + FY) / safe
    slope_x, slope_y = eye[0] / safe, eye[1] / safe
    d_u = tl.where(u == slope_x, -per_x * dot(*dt, *ahead), 0.0) + d_x * tl.load(view + FX)
    d_v = tl.where(v == slope_y, -per_y * dot(*dr, *ahead), 0.0) + d_y * tl.load(view + FY)
    d_per_x = dot(*dt, right[0] - u * ahead[0], right[1] - u * ahead[1], right[2] - u * ahead[2])
    d_per_y = dot(*dr, down[0] - v * ahead[0], down[1] - v * ahead[1], down[2] - v * ahead[2])
    d_depth = -(d_per_x * per_x + d_per_y * per_y + d_u * slope_x + d_v * slope_y) / safe
    return in_world(view, d_u / safe, d_v / safe, d_depth)


@triton.jit(do_not_specialize=["count", "views", "further"])
def project_back_kernel(
    means, quats, scales, covariances, opacities, shots, depths, d_records, d_means, d_quats, d_scales, d_covariances, d_opacities,
    count, views, further, HAS_COVARIANCES: tl.constexpr, RAW: tl.constexpr, VIEWER: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the gradients of all but the colors, summed over the views, or add them to what is there if `further` is 1. After `color_back_kernel`."""
    at = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    inside = at < count
    number = tl.program_id(0) * 0
    while number < views:
        view, row, adds = shots + number * NUMBERS, number.to(tl.int64) * count + at, number + further > 0
        drawn = inside & (tl.load(depths + row, inside, float("inf")) < float("inf"))
        d_record = d_records + row * RECORD
        d_x, d_y, d_along = load3(d_record, drawn)
        d_shear, d_across, d_log2_opacity = load3(d_record + 3, drawn)
        world, eye, safe = relative_position(view, means, at, drawn)
        safe = tl.where(drawn, safe, 1.0)  # with a near plane of 0, the depth of a splat that is not drawn may be 0
        dx, dy, dz, per = direction(world)
        px, py, pz = load3(d_record + 6, drawn)
        along = px * dx + py * dy + pz * dz  # removed below: the color does not change along the ray

        xx, xy, yy, det = image_covariance(view, eye, safe, quats, scales, covariances, at, drawn, HAS_COVARIANCES, RAW)
        opacity = tl.where(drawn, load_opacity(opacities, at, drawn, RAW), 1.0)
        d_xx, d_xy, d_yy, d_det, d_opacity = filter_back(view, opacity, xx, xy, yy, det, d_along, d_shear, d_across, d_log2_opacity, VIEWER)
        if RAW:
            d_opacity *= opacity * (1 - opacity)
        add(d_opacities + at, tl.where(drawn, d_opacity, 0.0), inside, adds)
        # Splats that are not drawn were read as zeros, from which NaN may follow.
        d_xx, d_xy = tl.where(drawn, d_xx, 0.0), tl.where(drawn, d_xy, 0.0)
        d_yy, d_det = tl.where(drawn, d_yy, 0.0), tl.where(drawn, d_det, 0.0)
        u, v = clamped_slopes(view, eye[0] / safe, eye[1] / safe)
        t = image_axis(view, u, tl.load(view + FX) / safe, 0)
        r = image_axis(view, v, tl.load(view + FY) / safe, 1)
        if HAS_COVARIANCES:
            covariance, d_covariance = covariances + 9 * at, d_covariances + 9 * at
            dt, dr = from_covariance_back(covariance, drawn, t, r, d_xx, d_xy, d_yy, d_det, d_covariance, inside, adds)
        else:
            quat, scale = load_quat(quats + 4 * at, drawn), load_scale(scales, at, drawn, RAW)
            d_quat, d_scale = d_quats + 4 * at, d_scales + 3 * at
            dt, dr = from_axes_back(quat, scale, t, r, d_xx, d_xy, d_yy, d_det, d_quat, d_scale, inside, adds, RAW)
        mx, my, mz = relative_position_back(view, eye, safe, u, v, dt, dr, d_x, d_y)
        mx, my, mz = mx + per * (px - along * dx), my + per * (py - along * dy), mz + per * (pz - along * dz)
        add3(d_means + 3 * at, tl.where(drawn, mx, 0.0), tl.where(drawn, my, 0.0), tl.where(drawn, mz, 0.0), inside, adds)
        number += 1
        tl.debug_barrier()  # the next view's gradients are added to what another thread may have stored
