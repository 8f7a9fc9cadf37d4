"""Splats in the world -> rows of the splat table, and the way back for gradients. Geometry in float64: it is not what takes time."""

import math

import numba
import numpy as np

from mipmap_plugin.backends.cpu_kernels import harmonics
from mipmap_plugin.backends.cpu_kernels.binning import count_tiles
from mipmap_plugin.backends.cpu_kernels.records import (
    BLUE, FALL_X, FALL_Y, GREEN, MIN_ALPHA, MIN_COMPENSATION, PEAK, REACH_Y, RED, SHEAR,
    SUM, SUM_U, SUM_UU, SUM_UY, SUM_Y, SUM_YY, TIP, PULLS, X, Y,
)  # fmt: skip
from mipmap_plugin.backends.cpu_kernels.tuples import cross, dot, plus, row, times, weighted

# -q/2 = -HALF_LOG2E · q in powers of two.
HALF_LOG2E = 0.5 / math.log(2)

# Sizes (px, px²) and brightnesses beyond this are as good as infinite: float32 could not carry their squares.
FAR = 1e30


@numba.njit(cache=True, nogil=True, error_model="numpy")
def project(start, stop, view, splats, table, depths, counts):
    """Fill the rows start..stop of the table, the depths and the numbers of tiles touched; 0 tiles: not drawn."""
    bands = np.empty(harmonics.MAX_BANDS)
    for i in range(start, stop):
        counts[i] = 0
        p = in_camera(view, row(splats.means, i))
        if not p[2] > view.near:
            continue
        depths[i] = p[2]
        if fill_shape(view, splats, i, p, table):
            tiles = count_tiles(table, i, view.width, view.height)
            if tiles > 0 and fill_color(view, splats, i, bands, table):
                counts[i] = tiles


@numba.njit(cache=True)
def fill_shape(view, splats, i, p, table):
    """Write what a splat's ellipse is on the image; False where there is none to draw."""
    x, y = view.fx * p[0] / p[2] + view.cx, view.fy * p[1] / p[2] + view.cy
    xx, xy, yy, det = flatten(splats, i, lens(view, p))
    xx, yy, det, light = screen_filter(view, xx, yy, det)
    opacity = splats.opacities[i] * light
    small = abs(x) < FAR and abs(y) < FAR and xx < FAR and yy < FAR and opacity < FAR
    sharp = yy * FAR > 1 and det * FAR > yy
    if not (small and sharp and opacity >= MIN_ALPHA):  # False for NaN, too
        return False
    reach = 2 * math.log(opacity / MIN_ALPHA)
    table[i, X], table[i, Y], table[i, SHEAR] = x, y, xy / yy
    table[i, FALL_Y], table[i, FALL_X], table[i, PEAK] = HALF_LOG2E / yy, HALF_LOG2E * yy / det, math.log2(opacity)
    table[i, REACH_Y], table[i, TIP] = math.sqrt(reach * yy), xy * math.sqrt(reach / xx)
    return True


@numba.njit(cache=True)
def fill_color(view, splats, i, bands, table):
    """Write a splat's color in this view's direction; False where it is not finite."""
    direction, _ = sight(view, splats, i)
    harmonics.basis(direction, view.sh_degree, bands)
    red, green, blue = 0.5, 0.5, 0.5
    for j in range((view.sh_degree + 1) ** 2):
        red += bands[j] * splats.sh[i, j, 0]
        green += bands[j] * splats.sh[i, j, 1]
        blue += bands[j] * splats.sh[i, j, 2]
    table[i, RED], table[i, GREEN], table[i, BLUE] = max(red, 0.0), max(green, 0.0), max(blue, 0.0)
    return abs(red) < FAR and abs(green) < FAR and abs(blue) < FAR


@numba.njit(cache=True, nogil=True, error_model="numpy")
def project_back(start, stop, view, splats, table, slots, pulls, grads):
    """Gradients of the splats start..stop from the pulls of their tiles, rows slots[i]..slots[i + 1]."""
    bands, along = np.empty(harmonics.MAX_BANDS), np.empty(harmonics.MAX_BANDS)
    pull = np.empty(PULLS)
    for i in range(start, stop):
        clear(grads, i)
        if slots[i] == slots[i + 1]:
            continue
        pull[:] = 0
        for slot in range(slots[i], slots[i + 1]):  # always in this order, whatever thread made the rows
            for k in range(PULLS):
                pull[k] += pulls[slot, k]
        d_mean = plus(pull_shape(view, splats, i, table, pull, grads), pull_color(view, splats, i, table, pull, bands, along, grads))
        grads.means[i, 0], grads.means[i, 1], grads.means[i, 2] = d_mean


@numba.njit(cache=True)
def clear(grads, i):
    grads.means[i] = 0
    grads.opacities[i] = 0
    grads.sh[i] = 0
    if len(grads.covariances) > 0:
        grads.covariances[i] = 0
    else:
        grads.quats[i] = 0
        grads.scales[i] = 0


@numba.njit(cache=True)
def pull_shape(view, splats, i, table, pull, grads):
    """Gradients through the ellipse: writes those of opacity and shape, returns that of the mean [3]."""
    p = in_camera(view, row(splats.means, i))
    axes = lens(view, p)
    sharp_xx, xy, sharp_yy, sharp_det = flatten(splats, i, axes)
    xx, yy, det, light = screen_filter(view, sharp_xx, sharp_yy, sharp_det)
    shear, per_yy, per_across = xy / yy, 1 / yy, yy / det

    d_x = per_across * pull[SUM_U]
    d_y = per_yy * pull[SUM_Y] - shear * d_x
    d_shear = per_across * pull[SUM_UY]
    d_per_yy, d_per_across = -0.5 * pull[SUM_YY], -0.5 * pull[SUM_UU]
    d_opacity = pull[SUM] / (splats.opacities[i] * light)

    d_xy = d_shear * per_yy
    d_yy = -(d_per_yy * per_yy + d_shear * shear) * per_yy + d_per_across / det
    d_det = -d_per_across * per_across / det
    d_sharp_det = d_det
    if view.antialiased and light > MIN_COMPENSATION:
        d_ratio = 0.5 * d_opacity * splats.opacities[i] / light
        d_sharp_det += d_ratio / det
        d_det -= d_ratio * sharp_det / det**2
        d_sharp_det = d_det + d_ratio / det
    grads.opacities[i] = d_opacity * light
    d_xx, d_yy = view.eps2d * d_det, d_yy + view.eps2d * d_det
    return pull_lens(view, p, axes, flatten_back(splats, i, axes, (d_xx, d_xy, d_yy, d_sharp_det), grads), d_x, d_y)


@numba.njit(cache=True)
def pull_color(view, splats, i, table, pull, bands, along, grads):
    """Gradients through the color: writes those of the coefficients, returns that of the mean [3]."""
    direction, length = sight(view, splats, i)
    harmonics.basis(direction, view.sh_degree, bands)
    # A channel that was cut off at black has no gradient.
    d_red = pull[RED] if table[i, RED] > 0 else 0.0
    d_green = pull[GREEN] if table[i, GREEN] > 0 else 0.0
    d_blue = pull[BLUE] if table[i, BLUE] > 0 else 0.0
    for j in range((view.sh_degree + 1) ** 2):
        along[j] = d_red * splats.sh[i, j, 0] + d_green * splats.sh[i, j, 1] + d_blue * splats.sh[i, j, 2]
        grads.sh[i, j, 0], grads.sh[i, j, 1], grads.sh[i, j, 2] = d_red * bands[j], d_green * bands[j], d_blue * bands[j]
    d_direction = harmonics.slope(direction, view.sh_degree, along)
    if length == 0:
        return 0.0, 0.0, 0.0
    return weighted(1 / length, d_direction, -dot(d_direction, direction) / length, direction)


@numba.njit(cache=True)
def in_camera(view, mean):
    r, t = view.rotation, view.translation
    return dot(row(r, 0), mean) + t[0], dot(row(r, 1), mean) + t[1], dot(row(r, 2), mean) + t[2]


@numba.njit(cache=True)
def sight(view, splats, i):
    """The unit vector from the eye to splat i, and its length before; (0, 0, 1) for a splat in the very eye."""
    ray = splats.means[i, 0] - view.eye[0], splats.means[i, 1] - view.eye[1], splats.means[i, 2] - view.eye[2]
    length = math.sqrt(dot(ray, ray))
    if length == 0:
        return (0.0, 0.0, 1.0), length
    return times(1 / length, ray), length


@numba.njit(cache=True)
def slopes(view, p):
    """x/z and y/z, frozen where the affine approximation of the projection would blow splats up."""
    u = min(max(p[0] / p[2], view.slopes[0]), view.slopes[1])
    v = min(max(p[1] / p[2], view.slopes[2]), view.slopes[3])
    return u, v


@numba.njit(cache=True)
def lens(view, p):
    """The two rows of the projection's Jacobian in world axes, px per world unit."""
    u, v = slopes(view, p)
    across, down, away = row(view.rotation, 0), row(view.rotation, 1), row(view.rotation, 2)
    per_x, per_y = view.fx / p[2], view.fy / p[2]
    return weighted(per_x, across, -per_x * u, away), weighted(per_y, down, -per_y * v, away)


@numba.njit(cache=True)
def pull_lens(view, p, axes, d_axes, d_x, d_y):
    """The gradient of a mean [3] in world axes, from those of its Jacobian and of its place on the image."""
    u, v = slopes(view, p)
    z, away = p[2], row(view.rotation, 2)
    per_x, per_y = view.fx / z, view.fy / z
    d_p0, d_p1 = d_x * per_x, d_y * per_y
    if view.slopes[0] <= p[0] / z <= view.slopes[1]:
        d_p0 -= per_x * dot(away, d_axes[0]) / z
    if view.slopes[2] <= p[1] / z <= view.slopes[3]:
        d_p1 -= per_y * dot(away, d_axes[1]) / z
    d_p2 = -(d_p0 * p[0] + d_p1 * p[1] + dot(axes[0], d_axes[0]) + dot(axes[1], d_axes[1])) / z
    return plus(weighted(d_p0, row(view.rotation, 0), d_p1, row(view.rotation, 1)), times(d_p2, away))


@numba.njit(cache=True)
def screen_filter(view, xx, yy, det):
    """Dilated xx, yy and determinant, and the share of its opacity that the splat keeps."""
    dilated = det + view.eps2d * (xx + yy) + view.eps2d**2  # = xx·yy - xy² without its cancellation
    light = max(math.sqrt(det / dilated), MIN_COMPENSATION) if view.antialiased else 1.0
    return xx + view.eps2d, yy + view.eps2d, dilated, light


@numba.njit(cache=True)
def flatten(splats, i, axes):
    """xx, xy, yy in px² and the determinant of splat i on the image, from its scales and quaternion or from its covariance."""
    if len(splats.covariances) > 0:
        first, second = image_of(splats.covariances[i], axes[0]), image_of(splats.covariances[i], axes[1])
        xx, xy, yy = dot(axes[0], first), dot(axes[0], second), dot(axes[1], second)
        return xx, xy, yy, max(xx * yy - xy * xy, 0.0)
    own, _ = own_axes(splats.quats, i)
    first, second = factor(splats.scales, i, own, axes[0]), factor(splats.scales, i, own, axes[1])
    minors = cross(first, second)
    return dot(first, first), dot(first, second), dot(second, second), dot(minors, minors)


@numba.njit(cache=True)
def flatten_back(splats, i, axes, d_flat, grads):
    """Writes the gradients of what shapes splat i; returns those of the two Jacobian rows."""
    d_xx, d_xy, d_yy, d_det = d_flat
    if len(splats.covariances) > 0:
        return covariance_back(splats.covariances[i], axes, d_flat, grads.covariances[i])
    own, unit = own_axes(splats.quats, i)
    first, second = factor(splats.scales, i, own, axes[0]), factor(splats.scales, i, own, axes[1])
    minors = cross(first, second)
    d_first = plus(weighted(2 * d_xx, first, d_xy, second), times(2 * d_det, cross(second, minors)))
    d_second = plus(weighted(2 * d_yy, second, d_xy, first), times(2 * d_det, cross(minors, first)))
    s = row(splats.scales, i)
    d_own = (
        times(s[0], weighted(d_first[0], axes[0], d_second[0], axes[1])),
        times(s[1], weighted(d_first[1], axes[0], d_second[1], axes[1])),
        times(s[2], weighted(d_first[2], axes[0], d_second[2], axes[1])),
    )
    for k in range(3):
        grads.scales[i, k] = d_first[k] * dot(axes[0], own[k]) + d_second[k] * dot(axes[1], own[k])
    grads.quats[i, 0], grads.quats[i, 1], grads.quats[i, 2], grads.quats[i, 3] = quaternion_back(splats.quats, i, unit, d_own)
    return weighted_axes(s, d_first, own), weighted_axes(s, d_second, own)


@numba.njit(cache=True)
def covariance_back(covariance, axes, d_flat, d_covariance):
    """Writes the gradient of a covariance, which need not be symmetric; returns those of the two Jacobian rows."""
    first, second = axes
    d_xx, d_xy, d_yy, d_det = d_flat
    seen_first, seen_second = image_of(covariance, first), image_of(covariance, second)
    xx, xy, yy = dot(first, seen_first), dot(first, seen_second), dot(second, seen_second)
    if xx * yy > xy * xy:
        d_xx, d_yy, d_xy = d_xx + d_det * yy, d_yy + d_det * xx, d_xy - 2 * d_det * xy
    for r in range(3):
        for c in range(3):
            d_covariance[r, c] = first[r] * (d_xx * first[c] + d_xy * second[c]) + d_yy * second[r] * second[c]
    d_first = plus(times(d_xx, plus(seen_first, image_of(covariance.T, first))), times(d_xy, seen_second))
    d_second = plus(times(d_yy, plus(seen_second, image_of(covariance.T, second))), times(d_xy, image_of(covariance.T, first)))
    return d_first, d_second


@numba.njit(cache=True)
def image_of(matrix, v):
    return dot(row(matrix, 0), v), dot(row(matrix, 1), v), dot(row(matrix, 2), v)


@numba.njit(cache=True)
def factor(scales, i, own, axis):
    """One row of Jacobian · rotation · scales."""
    return dot(axis, own[0]) * scales[i, 0], dot(axis, own[1]) * scales[i, 1], dot(axis, own[2]) * scales[i, 2]


@numba.njit(cache=True)
def weighted_axes(s, d, own):
    return plus(weighted(s[0] * d[0], own[0], s[1] * d[1], own[1]), times(s[2] * d[2], own[2]))


@numba.njit(cache=True)
def own_axes(quats, i):
    """The splat's three axes in the world, and its unit quaternion; a zero quaternion does not turn."""
    w, x, y, z = float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])
    squared = w * w + x * x + y * y + z * z
    per_norm = 0.0 if squared == 0 else 1 / math.sqrt(squared)
    w, x, y, z = w * per_norm, x * per_norm, y * per_norm, z * per_norm
    first = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)
    second = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)
    third = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
    return (first, second, third), (w, x, y, z, per_norm)


@numba.njit(cache=True)
def quaternion_back(quats, i, unit, d_own):
    """The gradient of a quaternion of any norm from those of the three axes."""
    w, x, y, z, per_norm = unit
    a, b, c = d_own
    d_w = 2 * (z * (a[1] - b[0]) + y * (c[0] - a[2]) + x * (b[2] - c[1]))
    d_x = 2 * (y * (a[1] + b[0]) + z * (a[2] + c[0]) + w * (b[2] - c[1])) - 4 * x * (b[1] + c[2])
    d_y = 2 * (x * (a[1] + b[0]) + z * (b[2] + c[1]) + w * (c[0] - a[2])) - 4 * y * (a[0] + c[2])
    d_z = 2 * (x * (a[2] + c[0]) + y * (b[2] + c[1]) + w * (a[1] - b[0])) - 4 * z * (a[0] + b[1])
    radial = d_w * w + d_x * x + d_y * y + d_z * z
    return (d_w - radial * w) * per_norm, (d_x - radial * x) * per_norm, (d_y - radial * y) * per_norm, (d_z - radial * z) * per_norm
