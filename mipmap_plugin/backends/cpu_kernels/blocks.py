"""Blocks of 16 splats, field by field: field k of all 16 is one set of lanes, at block[16 * k].

Of a block of float64, and by `get_part` of one of float32, a part of the splats is read: those from the pointer on. `beyond` moves it.
"""

# numba redefines calls and operators.
# mypy: ignore-errors

from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH
from mipmap_plugin.backends.cpu_kernels.memory import load, load_part, store


@inner
def get(block, field):
    return load(block, field * WIDTH)


@inner
def get_part(block, field):
    return load_part(block, field * WIDTH)


@inner
def get_vector(block, field):
    """Three consecutive fields."""
    return get(block, field), get(block, field + 1), get(block, field + 2)


@inner
def put(block, field, values):
    store(block, field * WIDTH, values)


@inner
def put_vector(block, field, values):
    put(block, field, values[0])
    put(block, field + 1, values[1])
    put(block, field + 2, values[2])
