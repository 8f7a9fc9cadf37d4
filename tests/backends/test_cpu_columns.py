"""Rows and columns of 16 in vectors, against numpy."""

import numpy as np
import pytest

numba = pytest.importorskip("numba")
from mipmap_plugin.backends.cpu_kernels.columns import apart, outlines, repeated, thrice, together, transpose  # noqa: E402
from mipmap_plugin.backends.cpu_kernels.layout import OUTLINE_FIELDS, SPLAT_FIELDS  # noqa: E402
from mipmap_plugin.backends.cpu_kernels.memory import load, pointer, store, store_bit_ranges, store_integers  # noqa: E402


@numba.njit
def transposed(source, target):
    transpose(pointer(source), pointer(target))


@numba.njit
def load_3(source):
    return load(source, 0), load(source, 16), load(source, 32)


@numba.njit
def load_4(source):
    return load(source, 0), load(source, 16), load(source, 32), load(source, 48)


def of_columns(change, loaded):
    """A kernel that stores what `change` makes of some columns."""

    @numba.njit
    def changed(source, target):
        for k, part in enumerate(change(loaded(source))):
            store(target, 16 * k, part)

    return changed


@numba.njit
def outlines_of(table, splats, begin, end, target):
    for k, field in enumerate(outlines(table, pointer(splats), begin, end)):
        store(target, 16 * k, field)


@numba.njit
def ranges(begins, ends, words):
    store_bit_ranges(pointer(words), load_4(begins), load_4(ends))


@numba.njit
def integers(source, target):
    store_integers(pointer(target), 1, load(source, 0))


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


@pytest.mark.parametrize(("loaded", "columns"), [(load_3, 3), (load_4, 4)])
def test_columns_apart_and_together(loaded, columns):
    source, target = made(of_columns(apart, loaded), 16 * columns, 16 * columns)
    assert np.array_equal(target.reshape(columns, 16), source.reshape(16, columns).T)
    source, target = made(of_columns(together, loaded), 16 * columns, 16 * columns)
    assert np.array_equal(target.reshape(16, columns), source.reshape(columns, 16).T)


@pytest.mark.parametrize("count", [1, 7, 16, 20])
def test_outlines_of_some_splats(count):
    rng = np.random.default_rng(count)
    table, splats = rng.normal(size=(40, SPLAT_FIELDS)).astype(np.float32), rng.permutation(40).astype(np.int32)
    target = np.zeros(16 * OUTLINE_FIELDS, np.float32)
    outlines_of(table, splats, 3, 3 + count, target)
    shown = min(16, count)
    assert np.array_equal(target.reshape(OUTLINE_FIELDS, 16)[:, :shown], table[splats[3 : 3 + shown], :OUTLINE_FIELDS].T)


def test_bits_of_ranges():
    rng = np.random.default_rng(0)
    edges = np.sort(rng.integers(0, 17, (2, 4, 16)), axis=0).astype(np.float32)
    words = np.zeros(16, np.int64)
    ranges(edges[0].ravel(), edges[1].ravel(), words)
    for lane, word in enumerate(words.tolist()):
        expected = [edges[0, row, lane] <= bit < edges[1, row, lane] for row in range(4) for bit in range(16)]
        assert [bool(word >> bit & 1) for bit in range(64)] == expected


def test_lanes_as_integers():
    target = np.zeros(20, np.int32)
    integers(np.arange(-5, 11, dtype=np.float32), target)
    assert target.tolist() == [0, *range(-5, 11), 0, 0, 0]


def test_a_number_of_each_band_or_channel_for_each_coefficient():
    source, target = made(bands_and_channels, 16, 96)
    assert np.array_equal(target[:48], source.repeat(3)) and np.array_equal(target[48:], np.tile(source[:3], 16))
