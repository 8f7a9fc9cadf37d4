"""Blocks: the numbers of 16 splats, column by column, so that one column is one set of lanes."""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH
from mipmap_plugin.backends.cpu_kernels.memory import load, store


@inner
def get(block, column):
    return load(block, column * WIDTH)


@inner
def get_vector(block, column):
    """Three columns."""
    return get(block, column), get(block, column + 1), get(block, column + 2)


@inner
def put(block, column, values):
    store(block, column * WIDTH, values)


@inner
def put_vector(block, column, values):
    put(block, column, values[0])
    put(block, column + 1, values[1])
    put(block, column + 2, values[2])
