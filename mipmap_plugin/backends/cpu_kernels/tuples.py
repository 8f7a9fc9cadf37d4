"""Vectors of three, and matrices of three rows, as tuples, which numba keeps in registers."""

# numba redefines calls and operators.
# mypy: ignore-errors

from mipmap_plugin.backends.cpu_kernels import inner


@inner
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inner
def plus(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inner
def minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inner
def times(s, a):
    return s * a[0], s * a[1], s * a[2]


@inner
def weighted_sum(s, a, t, b):
    """s·a + t·b"""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@inner
def apply(matrix, v):
    """matrix · v"""
    return dot(matrix[0], v), dot(matrix[1], v), dot(matrix[2], v)


@inner
def apply_transposed(matrix, v):
    """matrixᵀ · v"""
    return plus(weighted_sum(v[0], matrix[0], v[1], matrix[1]), times(v[2], matrix[2]))
