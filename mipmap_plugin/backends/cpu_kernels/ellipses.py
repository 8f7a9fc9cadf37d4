"""The ellipses of 16 splats on the image from their shapes in the world, and the way back for gradients (EWA projection, as in 3DGS).

All numbers are lanes of float64.

Shapes and their gradients on the image are (xx, xy, yy, det): the covariance in px², and its determinant on its own, since
xx·yy - xy² cancels for needles.
"""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.lanes import both, maximum, minimum, select, sqrt
from mipmap_plugin.backends.cpu_kernels.tuples import apply, apply_transposed, blend, cross, dot, plus, times
from mipmap_plugin.splatting.rotations import LEAST_QUATERNION


@inner
def lens(view, p):
    """The two rows of the projection's Jacobian at a point of camera space, in world axes, px per world unit.

    x/z and y/z are frozen where the affine approximation of the projection would blow splats up.
    """
    per_z = 1 / p[2]
    u, v = minimum(maximum(p[0] * per_z, view.left), view.right), minimum(maximum(p[1] * per_z, view.top), view.bottom)
    _, _, away = view.rotation
    per_x, per_y = view.fx * per_z, view.fy * per_z
    return blend(per_x, view.rotation[0], -per_x * u, away), blend(per_y, view.rotation[1], -per_y * v, away)


@inner
def pull_point(view, p, axes, d_axes, d_x, d_y):
    """The gradient of a mean in world space from those of its Jacobian's rows and of its place on the image."""
    across, down, away = view.rotation
    per_z = 1 / p[2]
    per_x, per_y, u, v = view.fx * per_z, view.fy * per_z, p[0] * per_z, p[1] * per_z
    free_u, free_v = both(u >= view.left, u <= view.right), both(v >= view.top, v <= view.bottom)
    d_p0 = per_x * select(free_u, d_x - dot(away, d_axes[0]) * per_z, d_x)
    d_p1 = per_y * select(free_v, d_y - dot(away, d_axes[1]) * per_z, d_y)
    d_p2 = -(d_p0 * p[0] + d_p1 * p[1] + dot(axes[0], d_axes[0]) + dot(axes[1], d_axes[1])) * per_z
    return plus(blend(d_p0, across, d_p1, down), times(d_p2, away))


@inner
def screen_filter(view, flat):
    """The shape after dilation, and the share of its opacity that the splat keeps."""
    xx, xy, yy, det = flat
    dilated = det + view.eps2d * (xx + yy) + view.eps2d * view.eps2d  # = xx·yy - xy² without its cancellation
    light = dilated * 0 + 1
    if view.least_light < 1:
        light = maximum(sqrt(det / dilated), view.least_light)
    return (xx + view.eps2d, xy, yy + view.eps2d, dilated), light


@inner
def pull_screen_filter(view, flat, dilated, light, d_dilated, d_light):
    """The gradient of a shape before dilation."""
    d_xx, d_xy, d_yy, d_det = d_dilated
    d_before = d_det
    if view.least_light < 1:
        per_dilated = 1 / dilated[3]
        d_ratio = select(light > view.least_light, 0.5 * d_light / light, 0.0) * per_dilated
        d_det = d_det - d_ratio * flat[3] * per_dilated
        d_before = d_det + d_ratio
    return d_xx + view.eps2d * d_det, d_xy, d_yy + view.eps2d * d_det, d_before


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
    return xx, xy, yy, maximum(xx * yy - xy * xy, 0.0)


@inner
def pull_flatten_matrix(axes, covariance, d_flat):
    """Gradients of the Jacobian's rows and of the covariance, which need not be symmetric."""
    first, second = axes
    d_xx, d_xy, d_yy, d_det = d_flat
    xx, xy, yy, det = flatten_matrix(axes, covariance)
    d_det = select(det > 0, d_det, 0.0)
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
    w, x, y, z = quat
    twice = 2 * per_square(quat)
    return (
        (1 - twice * (y * y + z * z), twice * (x * y + w * z), twice * (x * z - w * y)),
        (twice * (x * y - w * z), 1 - twice * (x * x + z * z), twice * (y * z + w * x)),
        (twice * (x * z + w * y), twice * (y * z - w * x), 1 - twice * (x * x + y * y)),
    )


@inner
def pull_rotation(quat, d_turn):
    """The gradient of a quaternion from those of the axes; across its length only."""
    w, x, y, z = quat
    shrink = per_square(quat)
    a, b, c = d_turn
    d_w = 2 * (z * (a[1] - b[0]) + y * (c[0] - a[2]) + x * (b[2] - c[1]))
    d_x = 2 * (y * (a[1] + b[0]) + z * (a[2] + c[0]) + w * (b[2] - c[1])) - 4 * x * (b[1] + c[2])
    d_y = 2 * (x * (a[1] + b[0]) + z * (b[2] + c[1]) + w * (c[0] - a[2])) - 4 * y * (a[0] + c[2])
    d_z = 2 * (x * (a[2] + c[0]) + y * (b[2] + c[1]) + w * (a[1] - b[0])) - 4 * z * (a[0] + b[1])
    along = (d_w * w + d_x * x + d_y * y + d_z * z) * shrink
    return shrink * (d_w - along * w), shrink * (d_x - along * x), shrink * (d_y - along * y), shrink * (d_z - along * z)


@inner
def per_square(quat):
    """1 / the square of its norm; 0 for a zero quaternion."""
    w, x, y, z = quat
    largest = maximum(maximum(maximum(w, -w), maximum(x, -x)), maximum(maximum(y, -y), maximum(z, -z)))
    return select(largest >= LEAST_QUATERNION, 1 / (w * w + x * x + y * y + z * z), 0.0)
