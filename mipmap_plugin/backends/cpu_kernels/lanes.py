"""Lanes: 16 float32 side by side, as a type that numba compiles straight to vector registers.

Plain loops are vectorized only when LLVM sees fit, and a loop that silently is not runs five times slower. With a type of its own
there is nothing left to see: `a + b` on `Lanes` is one vector addition on every processor. Scalars mix in freely and are spread
to all lanes. Nothing is reassociated, so that equal inputs give equal bits.
"""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

import operator
from functools import partial

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

from mipmap_plugin.backends.cpu_kernels import inner

WIDTH = 16

_FLOATS = ir.VectorType(ir.FloatType(), WIDTH)
_INTS = ir.VectorType(ir.IntType(32), WIDTH)


class _Lanes(types.Type):
    """WIDTH float32."""


class _Mask(types.Type):
    """WIDTH booleans."""


LANES, MASK = _Lanes("lanes"), _Mask("mask")


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _FLOATS)


@register_model(_Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), WIDTH))


def _spread(context, builder, value, kind):
    """`value` as lanes; a scalar goes to every lane."""
    if kind == LANES:
        return value
    scalar = context.cast(builder, value, kind, types.float32)
    first = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), scalar, ir.IntType(32)(0))
    return builder.shuffle_vector(first, ir.Constant(_FLOATS, ir.Undefined), ir.Constant(_INTS, [0] * WIDTH))


def _lane_wise(emit, result=LANES):
    """An intrinsic of `emit(builder, *vectors)` for arguments that are lanes or scalars."""

    def typed(*kinds):
        def generate(context, builder, signature, values):
            return emit(builder, *(_spread(context, builder, v, k) for v, k in zip(values, signature.args, strict=True)))

        return result(*kinds), generate

    return typed


def _call(name, builder, *vectors):
    """LLVM's own function of that name for vectors."""
    signature = ir.FunctionType(_FLOATS, [_FLOATS] * len(vectors))
    return builder.call(cgutils.get_or_insert_function(builder.module, signature, f"llvm.{name}.v{WIDTH}f32"), vectors)


def _operator(symbol, emit, result=LANES):
    """Teach numba `symbol` for two operands of which at least one is lanes."""
    typed = _lane_wise(emit, result)

    @intrinsic
    def apply(_context, left, right):
        return typed(left, right)

    @overload(symbol)
    def _apply(left, right):
        if LANES in (left, right):
            return lambda left, right: apply(left, right)
        return None


_operator(operator.add, lambda builder, a, b: builder.fadd(a, b))
_operator(operator.sub, lambda builder, a, b: builder.fsub(a, b))
_operator(operator.mul, lambda builder, a, b: builder.fmul(a, b))
_operator(operator.truediv, lambda builder, a, b: builder.fdiv(a, b))
_operator(operator.lt, lambda builder, a, b: builder.fcmp_ordered("<", a, b), MASK)
_operator(operator.ge, lambda builder, a, b: builder.fcmp_ordered(">=", a, b), MASK)


@intrinsic
def both(_context, first, second):
    """first and second, of two masks."""
    return MASK(first, second), lambda context, builder, signature, values: builder.and_(*values)


@intrinsic
def bits(_context, mask):
    """A mask as an integer: bit k is lane k."""

    def generate(context, builder, signature, values):
        return builder.zext(builder.bitcast(values[0], ir.IntType(WIDTH)), ir.IntType(64))

    return types.int64(mask), generate


@intrinsic
def lowest(_context, bits):
    """The place of the lowest bit that is set, for bits other than 0."""
    return types.int64(bits), lambda context, builder, signature, values: builder.cttz(values[0], ir.IntType(1)(1))


@intrinsic
def select(_context, mask, yes, no):
    """`yes` where the mask is set, else `no`. What is not taken may be anything, even NaN."""

    def generate(context, builder, signature, values):
        options = (_spread(context, builder, v, k) for v, k in zip(values[1:], signature.args[1:], strict=True))
        return builder.select(values[0], *options)

    return LANES(mask, yes, no), generate


@intrinsic
def fma(_context, a, b, c):
    """a·b + c, rounded once where the processor can."""
    return _lane_wise(partial(_call, "fmuladd"))(a, b, c)


@intrinsic
def minimum(_context, a, b):
    return _lane_wise(lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))(a, b)


@intrinsic
def maximum(_context, a, b):
    return _lane_wise(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))(a, b)


@intrinsic
def sqrt(_context, a):
    return _lane_wise(partial(_call, "sqrt"))(a)


@intrinsic
def floor(_context, a):
    return _lane_wise(partial(_call, "floor"))(a)


@intrinsic
def ceil(_context, a):
    return _lane_wise(partial(_call, "ceil"))(a)


@intrinsic
def spread(_context, value):
    """A scalar in every lane."""
    return _lane_wise(lambda builder, value: value)(value)


@intrinsic
def ramp(_context, start):
    """start, start + 1, ..., start + 15."""
    steps = ir.Constant(_FLOATS, [float(i) for i in range(WIDTH)])
    return _lane_wise(lambda builder, start: builder.fadd(start, steps))(start)


def _pointer(context, builder, kind, array, index):
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _FLOATS.as_pointer())


@intrinsic
def load(_context, array, index):
    """array[index : index + 16] of a contiguous float32 array [n]. The caller keeps within bounds."""

    def generate(context, builder, signature, values):
        index = context.cast(builder, values[1], signature.args[1], types.intp)
        return builder.load(_pointer(context, builder, signature.args[0], values[0], index), align=4)

    return LANES(array, index), generate


@intrinsic
def store(_context, array, index, lanes):
    """array[index : index + 16] = lanes."""

    def generate(context, builder, signature, values):
        index = context.cast(builder, values[1], signature.args[1], types.intp)
        builder.store(values[2], _pointer(context, builder, signature.args[0], values[0], index), align=4)
        return context.get_dummy_value()

    return types.void(array, index, lanes), generate


@intrinsic
def prefetch(_context, array, row):
    """Ask for array[row] of a contiguous array [n, m], so that it is at hand a little later."""

    def generate(context, builder, signature, values):
        kind = signature.args[0]
        record = context.make_array(kind)(context, builder, values[0])
        columns = builder.extract_value(record.shape, 1)
        row = context.cast(builder, values[1], signature.args[1], types.intp)
        place = builder.bitcast(builder.gep(record.data, [builder.mul(row, columns)]), cgutils.voidptr_t)
        number = ir.IntType(32)
        signature = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, signature, "llvm.prefetch.p0")
        builder.call(function, [place, number(0), number(3), number(1)])  # to read, into every cache, as data
        return context.get_dummy_value()

    return types.void(array, row), generate


@intrinsic
def total(_context, lanes):
    """The sum of all lanes, halves first: the same order on every processor."""

    def generate(context, builder, signature, values):
        value, width = values[0], WIDTH
        while width > 1:
            width //= 2
            halves = [ir.Constant(ir.VectorType(ir.IntType(32), width), list(range(at, at + width))) for at in (0, width)]
            value = builder.fadd(*(builder.shuffle_vector(value, value, half) for half in halves))
        return builder.extract_element(value, ir.IntType(32)(0))

    return types.float32(lanes), generate


@intrinsic
def _add_to_exponent(_context, lanes, rounded):
    """lanes · 2^n, for n held in the low bits of `rounded` as `exp2` leaves them."""

    def emit(builder, lanes, rounded):
        shift = ir.Constant(_INTS, [23] * WIDTH)
        bits = builder.add(builder.bitcast(lanes, _INTS), builder.shl(builder.bitcast(rounded, _INTS), shift))
        return builder.bitcast(bits, _FLOATS)

    return _lane_wise(emit)(lanes, rounded)


# 1.5 · 2^23: added to a float32 it leaves the nearest integer in the low bits.
_ROUNDER = 12582912.0


@inner
def exp2(power):
    """2^power to 1e-7 for -126 < power < 127; outside, anything. numba's own exponentials are scalar."""
    rounded = power + _ROUNDER
    rest = power - (rounded - _ROUNDER)  # -0.5 .. 0.5
    series = fma(rest, 0.00132647272, 0.00967151264)  # minimax in relative error, exactly 1 at 0
    series = fma(series, rest, 0.0555073374)
    series = fma(series, rest, 0.240222421)
    series = fma(series, rest, 0.693146978)
    series = fma(series, rest, 1.0)
    return _add_to_exponent(series, rounded)
