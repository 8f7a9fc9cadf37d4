"""Rows and columns of 16 in vectors, against numpy."""

import numpy as np
import pytest

numba = pytest.importorskip("numba")
from mipmap_plugin.backends.cpu_kernels.columns import apart, repeated, thrice, transpose  # noqa: E402
from mipmap_plugin.backends.cpu_kernels.memory import load, pointer, store  # noqa: E402


@numba.njit
def transposed(source, target):
    transpose(pointer(source), pointer(target))


@numba.njit
def columns_of_3(source, target):
    for k, column in enumerate(apart((load(source, 0), load(source, 16), load(source, 32)))):
        store(target, 16 * k, column)


@numba.njit
def columns_of_4(source, target):
    for k, column in enumerate(apart((load(source, 0), load(source, 16), load(source, 32), load(source, 48)))):
        store(target, 16 * k, column)


@numba.njit
def bands_and_channels(source, target):
    bands, channels = thrice(load(source, 0)), repeated(source[0], source[1], source[2])
    for k in range(3):
        store(target, 16 * k, bands[k])
        store(target, 48 + 16 * k, channels[k])


def made(function, numbers, size):
    source, target = np.arange(numbers, dtype=np.float32), np.zeros(size, np.float32)
    function(source, target)
    return source, target


def test_transposed():
    source, target = made(transposed, 256, 256)
    assert np.array_equal(target.reshape(16, 16), source.reshape(16, 16).T)


@pytest.mark.parametrize(("function", "columns"), [(columns_of_3, 3), (columns_of_4, 4)])
def test_columns_apart(function, columns):
    source, target = made(function, 16 * columns, 16 * columns)
    assert np.array_equal(target.reshape(columns, 16), source.reshape(16, columns).T)


def test_a_number_of_each_band_or_channel_for_each_coefficient():
    source, target = made(bands_and_channels, 16, 96)
    assert np.array_equal(target[:48], source.repeat(3)) and np.array_equal(target[48:], np.tile(source[:3], 16))
