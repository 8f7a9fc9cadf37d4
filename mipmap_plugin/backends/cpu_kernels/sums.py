"""Sums over the lanes of a set, and over many sets of lanes: of half as many lanes, for 9 sums are more than most processors have registers for."""

# numba redefines calls and operators.
# mypy: ignore-errors

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, Lanes, call, pattern

HALF = Lanes(types.float32, WIDTH // 2)


@intrinsic
def total(_context, lanes):
    """The sum of any number of lanes, adding halves: the same order on every processor."""

    def generate(context, builder, signature, values):
        value, width = values[0], lanes.width
        while width > 1:
            width //= 2
            value = builder.fadd(*_halves(builder, value, width))
        return builder.extract_element(value, ir.IntType(32)(0))

    return lanes.number(lanes), generate


def _halves(builder, value, width):
    """The first `width` lanes and the next as many."""
    return [builder.shuffle_vector(value, value, pattern(range(at, at + width))) for at in (0, width)]


@intrinsic
def zero_sum(_context):
    """A sum to begin with."""
    return HALF(), lambda context, builder, signature, values: ir.Constant(HALF.vector, None)


@intrinsic
def summed(_context, sums, lanes):
    """A sum plus the halves of lanes."""

    def generate(context, builder, signature, values):
        first, second = _halves(builder, values[1], HALF.width)
        return builder.fadd(builder.fadd(values[0], first), second)

    return HALF(sums, lanes), generate


@intrinsic
def summed_product(_context, sums, one, other):
    """A sum plus the halves of the product of two sets of lanes."""

    def generate(context, builder, signature, values):
        (one_first, one_second), (other_first, other_second) = (_halves(builder, value, HALF.width) for value in values[1:])
        return call("fmuladd", builder, one_second, other_second, call("fmuladd", builder, one_first, other_first, values[0]))

    return HALF(sums, one, other), generate


@intrinsic
def totals(_context, sums):
    """The totals of 8 sums, as 8 lanes; in the same order as `total`, in a third of the instructions."""

    def generate(context, builder, signature, values):
        vectors, segment = cgutils.unpack_tuple(builder, values[0], HALF.width), HALF.width
        while len(vectors) > 1:  # two vectors of segments become one of segments half as long
            pairs = zip(vectors[::2], vectors[1::2], strict=True)
            vectors, segment = [_add_halves(builder, *pair, segment) for pair in pairs], segment // 2
        return vectors[0]

    return HALF(sums), generate


def _add_halves(builder, first, second, segment):
    """Two vectors of segments as one, in which each segment is the sum of its halves."""
    starts = range(0, 2 * HALF.width, segment)
    firsts, seconds = ([start + half + k for start in starts for k in range(segment // 2)] for half in (0, segment // 2))
    return builder.fadd(*(builder.shuffle_vector(first, second, pattern(half)) for half in (firsts, seconds)))
