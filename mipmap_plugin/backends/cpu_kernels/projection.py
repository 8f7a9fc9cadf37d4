"""Splats in the world -> rows of the splat table, and the way back for gradients. Geometry in float64: it is not what takes time."""

import math

import numpy as np

from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels import ellipses, harmonics, inner, integrals, kernel, windows
from mipmap_plugin.backends.cpu_kernels.binning import count_tiles
from mipmap_plugin.backends.cpu_kernels.records import SEEN_AT_CENTER, SEEN_IN_PIXEL
from mipmap_plugin.backends.cpu_kernels.tuples import apply, blend, dot, minus, plus, row, set_row, times
from mipmap_plugin.effects import MIN_ALPHA

# -q/2 = -HALF_LOG2E · q in powers of two.
HALF_LOG2E = 0.5 / math.log(2)

# Sizes (px, px²) and brightnesses beyond this are as good as infinite: float32 could not carry their squares.
FAR = 1e30


@kernel
def project(start, stop, view, splats, table, depths, counts):
    """Fill the rows start..stop of the table, the depths and the numbers of tiles touched; 0 tiles: not drawn."""
    means, quats, scales, opacities, sh, covariances = splats
    bands = np.empty(harmonics.MAX_BANDS)
    for i in range(start, stop):
        counts[i] = 0
        mean = row(means, i)
        p = plus(apply(view.rotation, mean), view.translation)
        if not p[2] > view.near:
            continue
        depths[i] = p[2]
        if len(covariances) > 0:
            flat = ellipses.flatten_matrix(ellipses.lens(view, p), matrix(covariances, i))
        else:
            flat = ellipses.flatten(ellipses.lens(view, p), ellipses.rotation(quaternion(quats, i)), row(scales, i))
        if fill_shape(view, p, flat, opacities[i], table, i):
            tiles = count_tiles(table, i, view.width, view.height)
            if tiles > 0 and fill_color(view, mean, sh, bands, table, i):
                counts[i] = tiles


@inner
def fill_shape(view, p, flat, opacity, table, i):
    """Write what a splat's ellipse is on the image; False where there is none to draw."""
    x, y = view.fx * p[0] / p[2] + view.cx, view.fy * p[1] / p[2] + view.cy
    dilated, light = ellipses.screen_filter(view, flat)
    if view.seen == SEEN_AT_CENTER:
        return fill_ellipse(x, y, dilated, opacity * light, table, i)
    along = integrals.axes(dilated)
    if view.seen == SEEN_IN_PIXEL:
        mass, bound, corner = integrals.mass(along, opacity), integrals.BRIGHTER * opacity, integrals.CORNER
        drawn = integrals.brightest(along, opacity) >= MIN_ALPHA
    else:
        mass, bound, corner = opacity, opacity, windows.CORNER
        drawn = opacity >= MIN_ALPHA and along[3] * FAR > 1
    if not drawn:
        return False
    wider, bound = integrals.around(dilated, along, bound, corner)
    drawn = fill_ellipse(x, y, wider, bound, table, i)
    integrals.fill(along, mass, table, i)
    return drawn


@inner
def fill_ellipse(x, y, shape, opacity, table, i):
    """Write the ellipse alpha >= 1/255 of a shape; False where it is not finite, or not bright enough."""
    xx, xy, yy, det = shape
    small = abs(x) < FAR and abs(y) < FAR and xx < FAR and yy < FAR and opacity < FAR
    sharp = yy * FAR > 1 and det * FAR > yy
    if not (small and sharp and opacity >= MIN_ALPHA):  # NaN passes no comparison
        return False
    peak = math.log2(opacity)
    reach = 2 * math.log(2) * (peak - math.log2(MIN_ALPHA))
    table[i, col.X], table[i, col.Y], table[i, col.SHEAR] = x, y, xy / yy
    table[i, col.FALL_Y], table[i, col.FALL_X], table[i, col.PEAK] = HALF_LOG2E / yy, HALF_LOG2E * yy / det, peak
    table[i, col.SPREAD] = det / yy / HALF_LOG2E
    table[i, col.REACH_Y], table[i, col.TIP] = math.sqrt(reach * yy), xy * math.sqrt(reach / xx)
    return True


@inner
def fill_color(view, mean, sh, bands, table, i):
    """Write a splat's color in this view's direction; False where it is not finite."""
    direction, _ = sight(view, mean)
    harmonics.basis(direction, view.sh_degree, bands)
    red, green, blue = 0.5, 0.5, 0.5
    for j in range((view.sh_degree + 1) ** 2):
        red += bands[j] * sh[i, j, 0]
        green += bands[j] * sh[i, j, 1]
        blue += bands[j] * sh[i, j, 2]
    table[i, col.RED], table[i, col.GREEN], table[i, col.BLUE] = max(red, 0.0), max(green, 0.0), max(blue, 0.0)
    return abs(red) < FAR and abs(green) < FAR and abs(blue) < FAR


@kernel
def project_back(start, stop, view, splats, table, slots, pulls, grads):
    """Gradients of the splats start..stop from the pulls of their tiles, rows slots[i]..slots[i + 1]."""
    means, quats, scales, opacities, sh, covariances = splats
    d_means, d_quats, d_scales, d_opacities, d_sh, d_covariances = grads
    bands, along, pull = np.empty(harmonics.MAX_BANDS), np.empty(harmonics.MAX_BANDS), np.empty(col.PULLS)
    for i in range(start, stop):
        drawn = slots[i] < slots[i + 1]
        if not drawn:
            clear(i, d_means, d_quats, d_scales, d_opacities, d_sh, d_covariances)
            continue
        add_up(pulls, slots[i], slots[i + 1], pull)
        mean = row(means, i)
        p = plus(apply(view.rotation, mean), view.translation)
        axes = ellipses.lens(view, p)
        if len(covariances) > 0:
            covariance = matrix(covariances, i)
            d_flat, d_opacity, d_x, d_y = pull_shape(view, ellipses.flatten_matrix(axes, covariance), opacities[i], pull)
            d_axes, d_covariance = ellipses.pull_flatten_matrix(axes, covariance, d_flat)
            set_matrix(d_covariances, i, d_covariance)
        else:
            quat, scale = quaternion(quats, i), row(scales, i)
            turn = ellipses.rotation(quat)
            d_flat, d_opacity, d_x, d_y = pull_shape(view, ellipses.flatten(axes, turn, scale), opacities[i], pull)
            d_axes, d_turn, d_scale = ellipses.pull_flatten(axes, turn, scale, d_flat)
            set_row(d_scales, i, d_scale)
            d_quats[i, 0], d_quats[i, 1], d_quats[i, 2], d_quats[i, 3] = ellipses.pull_rotation(quat, d_turn)
        d_opacities[i] = d_opacity
        d_mean = pull_color(view, mean, sh, table, i, pull, bands, along, d_sh)
        set_row(d_means, i, plus(d_mean, ellipses.pull_point(view, p, axes, d_axes, d_x, d_y)))


@inner
def clear(i, d_means, d_quats, d_scales, d_opacities, d_sh, d_covariances):
    zero = 0.0, 0.0, 0.0
    set_row(d_means, i, zero)
    d_opacities[i] = 0
    for j in range(d_sh.shape[1]):
        d_sh[i, j, 0], d_sh[i, j, 1], d_sh[i, j, 2] = zero
    if len(d_covariances) > 0:
        set_matrix(d_covariances, i, (zero, zero, zero))
    else:
        set_row(d_scales, i, zero)
        d_quats[i, 0], d_quats[i, 1], d_quats[i, 2], d_quats[i, 3] = 0, 0, 0, 0


@inner
def add_up(pulls, first, last, pull):
    """Sum a splat's pulls, always tile after tile, whatever threads they came from."""
    for k in range(col.PULLS):
        pull[k] = pulls[first, k]
    for slot in range(first + 1, last):
        for k in range(col.PULLS):
            pull[k] += pulls[slot, k]


@inner
def pull_shape(view, flat, opacity, pull):
    """Gradients of the shape before the screen filter, of the opacity, and of the place on the image."""
    dilated, light = ellipses.screen_filter(view, flat)
    if view.seen != SEEN_AT_CENTER:
        return pull_integral(view, flat, dilated, opacity, pull)
    _, xy, yy, det = dilated
    shear, per_yy, per_across = xy / yy, 1 / yy, yy / det

    d_x = per_across * pull[col.SUM_U]
    d_y = per_yy * pull[col.SUM_Y] - shear * d_x
    d_shear = per_across * pull[col.SUM_UY]
    d_per_yy, d_per_across = -0.5 * pull[col.SUM_YY], -0.5 * pull[col.SUM_UU]

    d_yy = d_per_across / det - per_yy * (d_per_yy * per_yy + d_shear * shear)
    d_dilated = 0.0, d_shear * per_yy, d_yy, -d_per_across * per_across / det
    d_flat = ellipses.pull_screen_filter(view, flat, dilated, light, d_dilated, pull[col.SUM] / light)
    return d_flat, pull[col.SUM] / opacity, d_x, d_y


@inner
def pull_integral(view, flat, dilated, opacity, pull):
    """As `pull_shape`, of a splat that is integrated over pixels or windows."""
    cos, sin, long, short = integrals.axes(dilated)
    d_dilated = integrals.pull_axes(dilated, pull[col.GROW_LONG], pull[col.GROW_SHORT], pull[col.TURN])
    d_flat = ellipses.pull_screen_filter(view, flat, dilated, 1.0, d_dilated, 0.0)
    d_u, d_v = pull[col.BY_LONG] / long, pull[col.BY_SHORT] / short
    return d_flat, pull[col.SUM] / opacity, sin * d_v - cos * d_u, -sin * d_u - cos * d_v


@inner
def pull_color(view, mean, sh, table, i, pull, bands, along, d_sh):
    """Gradients through the color: writes those of the coefficients, returns that of the mean."""
    direction, length = sight(view, mean)
    harmonics.basis(direction, view.sh_degree, bands)
    # A channel that was cut off at black has no gradient.
    d_red = pull[col.RED] if table[i, col.RED] > 0 else 0.0
    d_green = pull[col.GREEN] if table[i, col.GREEN] > 0 else 0.0
    d_blue = pull[col.BLUE] if table[i, col.BLUE] > 0 else 0.0
    used = (view.sh_degree + 1) ** 2
    for j in range(used):
        along[j] = d_red * sh[i, j, 0] + d_green * sh[i, j, 1] + d_blue * sh[i, j, 2]
        d_sh[i, j, 0], d_sh[i, j, 1], d_sh[i, j, 2] = d_red * bands[j], d_green * bands[j], d_blue * bands[j]
    for j in range(used, d_sh.shape[1]):
        d_sh[i, j, 0], d_sh[i, j, 1], d_sh[i, j, 2] = 0, 0, 0
    if length == 0:
        return 0.0, 0.0, 0.0
    d_direction = harmonics.slope(direction, view.sh_degree, along)
    return blend(1 / length, d_direction, -dot(d_direction, direction) / length, direction)


@inner
def sight(view, mean):
    """The unit vector from the eye to a mean, and the distance; (0, 0, 1) and 0 for a splat in the very eye, and where nobody asks."""
    if view.sh_degree == 0:
        return (0.0, 0.0, 1.0), 0.0
    ray = minus(mean, view.eye)
    length = math.sqrt(dot(ray, ray))
    return (times(1 / length, ray) if length > 0 else (0.0, 0.0, 1.0)), length


@inner
def quaternion(quats, i):
    return float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])


@inner
def matrix(matrices, i):
    m = matrices
    return (
        (float(m[i, 0, 0]), float(m[i, 0, 1]), float(m[i, 0, 2])),
        (float(m[i, 1, 0]), float(m[i, 1, 1]), float(m[i, 1, 2])),
        (float(m[i, 2, 0]), float(m[i, 2, 1]), float(m[i, 2, 2])),
    )


@inner
def set_matrix(matrices, i, rows):
    for r, values in enumerate(rows):
        matrices[i, r, 0], matrices[i, r, 1], matrices[i, r, 2] = values
