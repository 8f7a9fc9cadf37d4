"""SIMD vectors: 16 float32 or 16 float64 lanes, as types that numba compiles straight to vector registers.

Plain loops are vectorized only when LLVM decides to, and a loop that silently is not runs five times slower. With types of their own,
`a + b` on lanes is one vector addition on every processor. Scalars mix in freely and are broadcast to all lanes; the two types mix
only through `wide` and `narrow`. Nothing is reassociated, so equal inputs give equal bits.
"""

# numba redefines calls and operators.
# mypy: ignore-errors

import operator
from functools import partial

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

WIDTH = 16

VECTOR32 = ir.VectorType(ir.FloatType(), WIDTH)
VECTOR64 = ir.VectorType(ir.DoubleType(), WIDTH)
INTS32 = ir.VectorType(ir.IntType(32), WIDTH)
INTS64 = ir.VectorType(ir.IntType(64), WIDTH)


class _Lanes(types.Type):
    """WIDTH float32."""


class _Doubles(types.Type):
    """WIDTH float64."""


class _Mask(types.Type):
    """WIDTH booleans."""


LANES, DOUBLES, MASK = _Lanes("lanes"), _Doubles("doubles"), _Mask("mask")


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, VECTOR32)


@register_model(_Doubles)
class _DoublesModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, VECTOR64)


@register_model(_Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), WIDTH))


def _common(kinds):
    """The type of an operation on `kinds`: float64 lanes if one of them is."""
    return DOUBLES if DOUBLES in kinds else LANES


def _broadcast(context, builder, value, kind, lanes):
    """`value` as `lanes`; a scalar is copied to every lane."""
    if kind == lanes:
        return value
    vector, number = (VECTOR64, types.float64) if lanes == DOUBLES else (VECTOR32, types.float32)
    scalar = context.cast(builder, value, kind, number)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.IntType(32)(0))
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), ir.Constant(INTS32, [0] * WIDTH))


def _generator(emit, lanes):
    """A lowering that calls `emit(builder, *vectors)` on lanes or scalars."""

    def generate(context, builder, signature, values):
        return emit(builder, *(_broadcast(context, builder, v, k, lanes) for v, k in zip(values, signature.args, strict=True)))

    return generate


def lane_wise(emit, result=None):
    """An intrinsic that calls `emit(builder, *vectors)` on lanes or scalars; `result`: its type if not the arguments'."""

    def typed(*kinds):
        lanes = _common(kinds)
        return (result or lanes)(*kinds), _generator(emit, lanes)

    return typed


def _call(name, builder, *vectors):
    """Call LLVM's intrinsic `name` on vectors."""
    kind = vectors[0].type
    suffix = "f64" if kind == VECTOR64 else "f32"
    signature = ir.FunctionType(kind, [kind] * len(vectors))
    return builder.call(cgutils.get_or_insert_function(builder.module, signature, f"llvm.{name}.v{WIDTH}{suffix}"), vectors)


def _operator(symbol, emit, result=None):
    """Define an operator for operands of which at least one is lanes; `result`: its type if not that of lanes.

    An `overload` would do the same, but numba compiles a function for each pair of types then: a third of all time to compile.
    """

    @type_callable(symbol)
    def type_of(_context):
        def typer(*kinds):
            return (result or _common(kinds)) if LANES in kinds or DOUBLES in kinds else None

        return typer

    for lanes in (LANES, DOUBLES):
        for kinds in ((lanes, lanes), (lanes, types.Number), (types.Number, lanes)):
            lower_builtin(symbol, *kinds)(_generator(emit, lanes))


_operator(operator.add, lambda builder, a, b: builder.fadd(a, b))
_operator(operator.sub, lambda builder, a, b: builder.fsub(a, b))
_operator(operator.mul, lambda builder, a, b: builder.fmul(a, b))
_operator(operator.truediv, lambda builder, a, b: builder.fdiv(a, b))
_operator(operator.lt, lambda builder, a, b: builder.fcmp_ordered("<", a, b), MASK)
_operator(operator.gt, lambda builder, a, b: builder.fcmp_ordered(">", a, b), MASK)
_operator(operator.ge, lambda builder, a, b: builder.fcmp_ordered(">=", a, b), MASK)
_operator(operator.le, lambda builder, a, b: builder.fcmp_ordered("<=", a, b), MASK)


@type_callable(operator.neg)
def _type_of_negative(_context):
    return lambda lanes: lanes if lanes in (LANES, DOUBLES) else None


for _lanes in (LANES, DOUBLES):
    lower_builtin(operator.neg, _lanes)(_generator(lambda builder, lanes: builder.fsub(ir.Constant(lanes.type, None), lanes), _lanes))


@intrinsic
def both(_context, first, second):
    """first and second, for two masks."""
    return MASK(first, second), lambda context, builder, signature, values: builder.and_(*values)


@intrinsic
def bits(_context, mask):
    """A mask as an integer: bit k is lane k."""

    def generate(context, builder, signature, values):
        return builder.zext(builder.bitcast(values[0], ir.IntType(WIDTH)), ir.IntType(64))

    return types.int64(mask), generate


@intrinsic
def lowest_bit(_context, bits):
    """The position of the lowest set bit of a nonzero integer."""
    return types.int64(bits), lambda context, builder, signature, values: builder.cttz(values[0], ir.IntType(1)(1))


@intrinsic
def select(_context, mask, yes, no):
    """`yes` where the mask is set, else `no`. Lanes that are not selected may hold anything, even NaN."""

    def generate(context, builder, signature, values):
        options = (_broadcast(context, builder, v, k, lanes) for v, k in zip(values[1:], signature.args[1:], strict=True))
        return builder.select(values[0], *options)

    lanes = _common((yes, no))
    return lanes(mask, yes, no), generate


@intrinsic
def fma(_context, a, b, c):
    """a·b + c, rounded once where the processor has such an instruction."""
    return lane_wise(partial(_call, "fmuladd"))(a, b, c)


@intrinsic
def minimum(_context, a, b):
    return lane_wise(lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))(a, b)


@intrinsic
def maximum(_context, a, b):
    return lane_wise(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))(a, b)


@intrinsic
def absolute(_context, a):
    return lane_wise(partial(_call, "fabs"))(a)


@intrinsic
def sqrt(_context, a):
    return lane_wise(partial(_call, "sqrt"))(a)


@intrinsic
def floor(_context, a):
    return lane_wise(partial(_call, "floor"))(a)


@intrinsic
def ceil(_context, a):
    return lane_wise(partial(_call, "ceil"))(a)


@intrinsic
def broadcast(_context, value):
    """A scalar in every lane."""
    return lane_wise(lambda builder, value: value)(value)


def _plus(steps):
    """An emitter of lanes plus the constants `steps` [16]."""
    constant = ir.Constant(VECTOR32, [float(step) for step in steps])
    return lambda builder, start: builder.fadd(start, constant)


@intrinsic
def across(_context, start):
    """start plus the column 0..3 of each lane, for lanes that are 4 x 4 pixels, row by row."""
    return lane_wise(_plus(lane % 4 for lane in range(WIDTH)))(start)


@intrinsic
def down(_context, start):
    """start plus the row 0..3 of each lane, for lanes that are 4 x 4 pixels, row by row."""
    return lane_wise(_plus(lane // 4 for lane in range(WIDTH)))(start)


@intrinsic
def wide(_context, lanes):
    """float32 as float64."""
    return DOUBLES(lanes), lambda context, builder, signature, values: builder.fpext(values[0], VECTOR64)


@intrinsic
def narrow(_context, doubles):
    """float64 rounded to float32; infinite where float32 overflows."""
    return LANES(doubles), lambda context, builder, signature, values: builder.fptrunc(values[0], VECTOR32)


@intrinsic
def total(_context, lanes):
    """The sum of all lanes, adding halves: the same order on every processor."""

    def generate(context, builder, signature, values):
        value, width = values[0], WIDTH
        while width > 1:
            width //= 2
            halves = [ir.Constant(ir.VectorType(ir.IntType(32), width), list(range(at, at + width))) for at in (0, width)]
            value = builder.fadd(*(builder.shuffle_vector(value, value, half) for half in halves))
        return builder.extract_element(value, ir.IntType(32)(0))

    return types.float32(lanes), generate


@intrinsic
def totals(_context, lanes):
    """The sums of all lanes of each of 8 lanes, in the first half of lanes; in the same order as `total`, in a third of the instructions."""

    def generate(context, builder, signature, values):
        vectors, segment = cgutils.unpack_tuple(builder, values[0], 8), WIDTH
        while len(vectors) > 1:  # two vectors of segments become one of segments half as long
            pairs = zip(vectors[::2], vectors[1::2], strict=True)
            vectors, segment = [_add_halves(builder, *pair, segment) for pair in pairs], segment // 2
        return _add_halves(builder, vectors[0], vectors[0], segment)

    return LANES(lanes), generate


def _add_halves(builder, first, second, segment):
    """Two vectors of segments as one, in which each segment is the sum of its halves."""
    starts = range(0, 2 * WIDTH, segment)
    firsts, seconds = ([start + half + k for start in starts for k in range(segment // 2)] for half in (0, segment // 2))
    return builder.fadd(*(builder.shuffle_vector(first, second, ir.Constant(INTS32, half)) for half in (firsts, seconds)))
