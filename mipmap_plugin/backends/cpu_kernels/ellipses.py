"""A splat's ellipse on the image from its shape in the world, and the way back for gradients (EWA projection, as 3DGS uses it).

Shapes and their gradients on the image are (xx, xy, yy, det): the covariance in px², and its determinant on its own, since
xx·yy - xy² cancels for needles.
"""

import math

from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.tuples import apply, apply_transposed, blend, cross, dot, plus, times


@inner
def lens(view, p):
    """The two rows of the projection's Jacobian at a point of camera space, in world axes, px per world unit."""
    u, v = slopes(view, p)
    _, _, away = view.rotation
    per_x, per_y = view.fx / p[2], view.fy / p[2]
    return blend(per_x, view.rotation[0], -per_x * u, away), blend(per_y, view.rotation[1], -per_y * v, away)


@inner
def slopes(view, p):
    """x/z and y/z, frozen where the affine approximation of the projection would blow splats up."""
    u = min(max(p[0] / p[2], view.left), view.right)
    v = min(max(p[1] / p[2], view.top), view.bottom)
    return u, v


@inner
def pull_point(view, p, axes, d_axes, d_x, d_y):
    """The gradient of a mean in world space from those of its Jacobian's rows and of its place on the image."""
    across, down, away = view.rotation
    z = p[2]
    per_x, per_y = view.fx / z, view.fy / z
    d_p0, d_p1 = d_x * per_x, d_y * per_y
    if view.left <= p[0] / z <= view.right:
        d_p0 -= per_x * dot(away, d_axes[0]) / z
    if view.top <= p[1] / z <= view.bottom:
        d_p1 -= per_y * dot(away, d_axes[1]) / z
    d_p2 = -(d_p0 * p[0] + d_p1 * p[1] + dot(axes[0], d_axes[0]) + dot(axes[1], d_axes[1])) / z
    return plus(blend(d_p0, across, d_p1, down), times(d_p2, away))


@inner
def screen_filter(view, flat):
    """The shape after dilation, and the share of its opacity that the splat keeps."""
    xx, xy, yy, det = flat
    dilated = det + view.eps2d * (xx + yy) + view.eps2d**2  # = xx·yy - xy² without its cancellation
    light = max(math.sqrt(det / dilated), view.least_light)
    return (xx + view.eps2d, xy, yy + view.eps2d, dilated), light


@inner
def pull_screen_filter(view, flat, dilated, light, d_dilated, d_light):
    """The gradient of a shape before dilation."""
    d_xx, d_xy, d_yy, d_det = d_dilated
    det, det_dilated = flat[3], dilated[3]
    d_ratio = 0.5 * d_light / light if light > view.least_light else 0.0
    d_det -= d_ratio * det / det_dilated**2
    return d_xx + view.eps2d * d_det, d_xy, d_yy + view.eps2d * d_det, d_det + d_ratio / det_dilated


@inner
def flatten(axes, turn, scales):
    """The shape on the image of a splat with its own axes `turn` and standard deviations `scales`."""
    first, second = factors(axes, turn, scales)
    minors = cross(first, second)
    return dot(first, first), dot(first, second), dot(second, second), dot(minors, minors)  # det: Cauchy-Binet, never negative


@inner
def factors(axes, turn, scales):
    """The two rows of Jacobian · rotation · scales."""
    first, second = apply(turn, axes[0]), apply(turn, axes[1])
    return (
        (first[0] * scales[0], first[1] * scales[1], first[2] * scales[2]),
        (second[0] * scales[0], second[1] * scales[1], second[2] * scales[2]),
    )


@inner
def pull_flatten(axes, turn, scales, d_flat):
    """Gradients of the Jacobian's rows, of the splat's own axes and of its scales."""
    d_xx, d_xy, d_yy, d_det = d_flat
    first, second = factors(axes, turn, scales)
    minors = cross(first, second)
    d_first = plus(blend(2 * d_xx, first, d_xy, second), times(2 * d_det, cross(second, minors)))
    d_second = plus(blend(2 * d_yy, second, d_xy, first), times(2 * d_det, cross(minors, first)))
    seen_first, seen_second = apply(turn, axes[0]), apply(turn, axes[1])
    d_scales = (
        d_first[0] * seen_first[0] + d_second[0] * seen_second[0],
        d_first[1] * seen_first[1] + d_second[1] * seen_second[1],
        d_first[2] * seen_first[2] + d_second[2] * seen_second[2],
    )
    d_first = d_first[0] * scales[0], d_first[1] * scales[1], d_first[2] * scales[2]
    d_second = d_second[0] * scales[0], d_second[1] * scales[1], d_second[2] * scales[2]
    d_turn = (
        blend(d_first[0], axes[0], d_second[0], axes[1]),
        blend(d_first[1], axes[0], d_second[1], axes[1]),
        blend(d_first[2], axes[0], d_second[2], axes[1]),
    )
    return (apply_transposed(turn, d_first), apply_transposed(turn, d_second)), d_turn, d_scales


@inner
def flatten_matrix(axes, covariance):
    """The shape on the image of a splat with a covariance in world space."""
    first, second = apply(covariance, axes[0]), apply(covariance, axes[1])
    xx, xy, yy = dot(axes[0], first), dot(axes[0], second), dot(axes[1], second)
    return xx, xy, yy, max(xx * yy - xy * xy, 0.0)


@inner
def pull_flatten_matrix(axes, covariance, d_flat):
    """Gradients of the Jacobian's rows and of the covariance, which need not be symmetric."""
    first, second = axes
    d_xx, d_xy, d_yy, d_det = d_flat
    xx, xy, yy, det = flatten_matrix(axes, covariance)
    if det > 0:
        d_xx, d_xy, d_yy = d_xx + d_det * yy, d_xy - 2 * d_det * xy, d_yy + d_det * xx
    d_covariance = (
        blend(first[0], blend(d_xx, first, d_xy, second), d_yy * second[0], second),
        blend(first[1], blend(d_xx, first, d_xy, second), d_yy * second[1], second),
        blend(first[2], blend(d_xx, first, d_xy, second), d_yy * second[2], second),
    )
    seen_first, seen_second = apply(covariance, first), apply(covariance, second)
    shown_first, shown_second = apply_transposed(covariance, first), apply_transposed(covariance, second)
    d_first = blend(d_xx, plus(seen_first, shown_first), d_xy, seen_second)
    d_second = blend(d_yy, plus(seen_second, shown_second), d_xy, shown_first)
    return (d_first, d_second), d_covariance


@inner
def rotation(quat):
    """The axes of a splat with a quaternion wxyz of any norm, each a row; a zero quaternion does not turn."""
    w, x, y, z = times_quat(per_norm(quat), quat)
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


@inner
def pull_rotation(quat, d_turn):
    """The gradient of a quaternion from those of the axes; across its length only."""
    shrink = per_norm(quat)
    w, x, y, z = times_quat(shrink, quat)
    a, b, c = d_turn
    d_w = 2 * (z * (a[1] - b[0]) + y * (c[0] - a[2]) + x * (b[2] - c[1]))
    d_x = 2 * (y * (a[1] + b[0]) + z * (a[2] + c[0]) + w * (b[2] - c[1])) - 4 * x * (b[1] + c[2])
    d_y = 2 * (x * (a[1] + b[0]) + z * (b[2] + c[1]) + w * (c[0] - a[2])) - 4 * y * (a[0] + c[2])
    d_z = 2 * (x * (a[2] + c[0]) + y * (b[2] + c[1]) + w * (a[1] - b[0])) - 4 * z * (a[0] + b[1])
    along = d_w * w + d_x * x + d_y * y + d_z * z
    return times_quat(shrink, (d_w - along * w, d_x - along * x, d_y - along * y, d_z - along * z))


@inner
def per_norm(quat):
    w, x, y, z = quat
    squared = w * w + x * x + y * y + z * z
    return 0.0 if squared == 0 else 1 / math.sqrt(squared)


@inner
def times_quat(s, quat):
    return s * quat[0], s * quat[1], s * quat[2], s * quat[3]
