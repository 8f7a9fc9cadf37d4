"""Vectors of three as tuples: numba keeps them in registers, nothing is allocated."""

import numba


@numba.njit(cache=True)
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(cache=True)
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@numba.njit(cache=True)
def times(s, a):
    return s * a[0], s * a[1], s * a[2]


@numba.njit(cache=True)
def plus(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@numba.njit(cache=True)
def weighted(s, a, t, b):
    """s·a + t·b"""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@numba.njit(cache=True)
def row(array, i):
    """Row i of [N, 3] as float64."""
    return float(array[i, 0]), float(array[i, 1]), float(array[i, 2])
