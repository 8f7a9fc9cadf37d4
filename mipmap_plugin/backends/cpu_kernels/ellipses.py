"""The ellipses of splats on the image from their shapes in the world, and the gradients (EWA projection, as in 3DGS).

All numbers are lanes of float64.

Shapes on the image, and their gradients, are (xx, xy, yy, det): the covariance in px², and its determinant, stored separately because
xx·yy - xy² cancels for needles.
"""

# numba redefines calls and operators.
# mypy: ignore-errors

from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.lanes import both, maximum, minimum, select, sqrt
from mipmap_plugin.backends.cpu_kernels.tuples import apply, apply_transposed, cross, dot, plus, times, weighted_sum
from mipmap_plugin.splatting.rotations import LEAST_QUATERNION


@inner
def jacobian(view, p):
    """The two rows of the projection's Jacobian at a point of camera space, in world axes, px per world unit.

    x/z and y/z are clamped to the view's bounds, beyond which the affine approximation of the projection would enlarge splats too much.
    """
    per_z = 1 / p[2]
    u, v = minimum(maximum(p[0] * per_z, view.left), view.right), minimum(maximum(p[1] * per_z, view.top), view.bottom)
    _, _, forward = view.rotation
    per_x, per_y = view.fx * per_z, view.fy * per_z
    return weighted_sum(per_x, view.rotation[0], -per_x * u, forward), weighted_sum(per_y, view.rotation[1], -per_y * v, forward)


@inner
def grad_mean(view, p, jac, d_jac, d_x, d_y):
    """The gradient of a mean in world space from those of its Jacobian's rows and of its position on the image."""
    right, down, forward = view.rotation
    per_z = 1 / p[2]
    per_x, per_y, u, v = view.fx * per_z, view.fy * per_z, p[0] * per_z, p[1] * per_z
    unclamped_u, unclamped_v = both(u >= view.left, u <= view.right), both(v >= view.top, v <= view.bottom)
    d_p0 = per_x * select(unclamped_u, d_x - dot(forward, d_jac[0]) * per_z, d_x)
    d_p1 = per_y * select(unclamped_v, d_y - dot(forward, d_jac[1]) * per_z, d_y)
    d_p2 = -(d_p0 * p[0] + d_p1 * p[1] + dot(jac[0], d_jac[0]) + dot(jac[1], d_jac[1])) * per_z
    return plus(weighted_sum(d_p0, right, d_p1, down), times(d_p2, forward))


@inner
def screen_filter(view, shape):
    """The shape after dilation, and the factor that compensates its opacity."""
    xx, xy, yy, det = shape
    dilated = det + view.eps2d * (xx + yy) + view.eps2d * view.eps2d  # = xx·yy - xy² without its cancellation
    compensation = dilated * 0 + 1
    if view.min_compensation < 1:
        compensation = maximum(sqrt(det / dilated), view.min_compensation)
    return (xx + view.eps2d, xy, yy + view.eps2d, dilated), compensation


@inner
def grad_screen_filter(view, shape, dilated, compensation, d_dilated, d_compensation):
    """The gradient of a shape before dilation."""
    d_xx, d_xy, d_yy, d_det = d_dilated
    d_before = d_det
    if view.min_compensation < 1:
        per_dilated = 1 / dilated[3]
        d_ratio = select(compensation > view.min_compensation, 0.5 * d_compensation / compensation, 0.0) * per_dilated
        d_det = d_det - d_ratio * shape[3] * per_dilated
        d_before = d_det + d_ratio
    return d_xx + view.eps2d * d_det, d_xy, d_yy + view.eps2d * d_det, d_before


@inner
def project_axes(jac, axes, scales):
    """The shape on the image of a splat with the given axes, one per row, and standard deviations `scales`."""
    first, second = scaled_axes(jac, axes, scales)
    minors = cross(first, second)
    return dot(first, first), dot(first, second), dot(second, second), dot(minors, minors)  # det: Cauchy-Binet, never negative


@inner
def scaled_axes(jac, axes, scales):
    """The two rows of Jacobian · rotation · scales."""
    first, second = apply(axes, jac[0]), apply(axes, jac[1])
    return (
        (first[0] * scales[0], first[1] * scales[1], first[2] * scales[2]),
        (second[0] * scales[0], second[1] * scales[1], second[2] * scales[2]),
    )


@inner
def grad_project_axes(jac, axes, scales, d_shape):
    """The gradients of the Jacobian's rows, of the splat's axes and of its scales."""
    d_xx, d_xy, d_yy, d_det = d_shape
    first, second = scaled_axes(jac, axes, scales)
    minors = cross(first, second)
    d_first = plus(weighted_sum(2 * d_xx, first, d_xy, second), times(2 * d_det, cross(second, minors)))
    d_second = plus(weighted_sum(2 * d_yy, second, d_xy, first), times(2 * d_det, cross(minors, first)))
    turned_first, turned_second = apply(axes, jac[0]), apply(axes, jac[1])
    d_scales = (
        d_first[0] * turned_first[0] + d_second[0] * turned_second[0],
        d_first[1] * turned_first[1] + d_second[1] * turned_second[1],
        d_first[2] * turned_first[2] + d_second[2] * turned_second[2],
    )
    d_first = d_first[0] * scales[0], d_first[1] * scales[1], d_first[2] * scales[2]
    d_second = d_second[0] * scales[0], d_second[1] * scales[1], d_second[2] * scales[2]
    d_axes = (
        weighted_sum(d_first[0], jac[0], d_second[0], jac[1]),
        weighted_sum(d_first[1], jac[0], d_second[1], jac[1]),
        weighted_sum(d_first[2], jac[0], d_second[2], jac[1]),
    )
    return (apply_transposed(axes, d_first), apply_transposed(axes, d_second)), d_axes, d_scales


@inner
def project_covariance(jac, covariance):
    """The shape on the image of a splat with a covariance in world space."""
    first, second = apply(covariance, jac[0]), apply(covariance, jac[1])
    xx, xy, yy = dot(jac[0], first), dot(jac[0], second), dot(jac[1], second)
    return xx, xy, yy, maximum(xx * yy - xy * xy, 0.0)


@inner
def grad_project_covariance(jac, covariance, d_shape):
    """The gradients of the Jacobian's rows and of the covariance, which need not be symmetric."""
    first, second = jac
    d_xx, d_xy, d_yy, d_det = d_shape
    xx, xy, yy, det = project_covariance(jac, covariance)
    d_det = select(det > 0, d_det, 0.0)
    d_xx, d_xy, d_yy = d_xx + d_det * yy, d_xy - 2 * d_det * xy, d_yy + d_det * xx
    d_covariance = (
        weighted_sum(first[0], weighted_sum(d_xx, first, d_xy, second), d_yy * second[0], second),
        weighted_sum(first[1], weighted_sum(d_xx, first, d_xy, second), d_yy * second[1], second),
        weighted_sum(first[2], weighted_sum(d_xx, first, d_xy, second), d_yy * second[2], second),
    )
    times_first, times_second = apply(covariance, first), apply(covariance, second)
    transposed_first, transposed_second = apply_transposed(covariance, first), apply_transposed(covariance, second)
    d_first = weighted_sum(d_xx, plus(times_first, transposed_first), d_xy, times_second)
    d_second = weighted_sum(d_yy, plus(times_second, transposed_second), d_xy, transposed_first)
    return (d_first, d_second), d_covariance


@inner
def rotation(quat):
    """The axes, one per row, of a splat with a quaternion wxyz of any norm; a zero quaternion is the identity."""
    w, x, y, z = quat
    two_per_norm2 = 2 * per_squared_norm(quat)
    return (
        (1 - two_per_norm2 * (y * y + z * z), two_per_norm2 * (x * y + w * z), two_per_norm2 * (x * z - w * y)),
        (two_per_norm2 * (x * y - w * z), 1 - two_per_norm2 * (x * x + z * z), two_per_norm2 * (y * z + w * x)),
        (two_per_norm2 * (x * z + w * y), two_per_norm2 * (y * z - w * x), 1 - two_per_norm2 * (x * x + y * y)),
    )


@inner
def grad_rotation(quat, d_axes):
    """The gradient of a quaternion from those of the axes; it is perpendicular to the quaternion."""
    w, x, y, z = quat
    per_norm2 = per_squared_norm(quat)
    a, b, c = d_axes
    d_w = 2 * (z * (a[1] - b[0]) + y * (c[0] - a[2]) + x * (b[2] - c[1]))
    d_x = 2 * (y * (a[1] + b[0]) + z * (a[2] + c[0]) + w * (b[2] - c[1])) - 4 * x * (b[1] + c[2])
    d_y = 2 * (x * (a[1] + b[0]) + z * (b[2] + c[1]) + w * (c[0] - a[2])) - 4 * y * (a[0] + c[2])
    d_z = 2 * (x * (a[2] + c[0]) + y * (b[2] + c[1]) + w * (a[1] - b[0])) - 4 * z * (a[0] + b[1])
    along = (d_w * w + d_x * x + d_y * y + d_z * z) * per_norm2
    return per_norm2 * (d_w - along * w), per_norm2 * (d_x - along * x), per_norm2 * (d_y - along * y), per_norm2 * (d_z - along * z)


@inner
def per_squared_norm(quat):
    """1 / the squared norm of a quaternion; 0 for a zero quaternion."""
    w, x, y, z = quat
    largest = maximum(maximum(maximum(w, -w), maximum(x, -x)), maximum(maximum(y, -y), maximum(z, -z)))
    return select(largest >= LEAST_QUATERNION, 1 / (w * w + x * x + y * y + z * z), 0.0)
