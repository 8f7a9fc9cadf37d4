"""Memory that is used again."""

import numpy as np
import pytest
import torch

from mipmap_plugin.process.pool import CACHE_LINE, LARGE, Pool


def address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def spare_bytes(pool: Pool) -> int:
    pool._collect()
    return sum(map(len, pool._spare))


def test_memory_is_used_again_when_its_array_is_gone():
    pool = Pool()
    first = pool.empty((2 * LARGE,), np.uint8)
    place = address(first)
    del first
    assert address(pool.empty((2 * LARGE - 100,), np.uint8)) == place


def test_memory_is_not_used_again_while_a_tensor_shows_it():
    pool = Pool()
    tensor = torch.from_numpy(pool.empty((LARGE, 2), np.float32))[3:, 1]
    other = torch.from_numpy(pool.empty((LARGE, 2), np.float32))
    tensor.fill_(1)
    other.fill_(2)
    assert (tensor == 1).all()


def test_spare_memory_is_released_and_memory_in_use_is_not():
    pool = Pool()
    used = pool.empty((2 * LARGE,), np.uint8)
    used.fill(1)
    pool.empty((2 * LARGE,), np.uint8)
    assert spare_bytes(pool) > 0
    pool.release()
    assert spare_bytes(pool) == 0 and (used == 1).all()
    del used
    assert spare_bytes(pool) > 0  # it came back after that


def test_a_much_larger_block_is_left_for_others():
    pool = Pool()
    pool.empty((4 * LARGE,), np.uint8)
    small = pool.empty((LARGE,), np.uint8)
    assert len(small) == LARGE
    assert spare_bytes(pool) > 4 * LARGE


def test_spare_memory_is_never_more_than_was_in_use_at_once():
    pool = Pool()
    for size in range(LARGE, 40 * LARGE, 3 * LARGE):
        pool.empty((size,), np.uint8)
    assert spare_bytes(pool) <= 38 * LARGE


@pytest.mark.parametrize("shape", [(3, 16), (LARGE, 3)])
def test_arrays_of_cache_lines_and_large_ones_begin_at_one(shape):
    assert address(Pool().empty(shape, np.float32)) % CACHE_LINE == 0


def test_memory_comes_back_while_the_pool_is_locked():
    pool = Pool()
    array = pool.empty((LARGE,), np.uint8)
    with pool._lock:  # as when Python looks for cycles in the middle of `empty`
        del array
    assert spare_bytes(pool) > 0
