"""SIMD vectors: lanes of float32 or float64, as types that numba compiles straight to vector registers.

Plain loops are vectorized only when LLVM decides to, and a loop that silently is not runs five times slower. With types of their own,
`a + b` on lanes is one vector addition on every processor. Scalars mix in freely and are broadcast to all lanes; float32 and float64 mix
only through `wide` and `narrow`. Nothing is reassociated, so equal inputs give equal bits.

There are WIDTH lanes of float32, and PART of float64, unless a docstring says otherwise.
"""

# numba redefines calls and operators.
# mypy: ignore-errors

import operator
from functools import partial

from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

WIDTH = 16

# Splats whose geometry is computed at a time: as many float64 as a register of AVX-512, or else of AVX2, holds. Of more the numbers do not fit
# into all registers.
PART = 8 if get_host_cpu_features().get("avx512f") else 4


class Lanes(types.Type):
    """So many numbers, float32 or float64."""

    def __init__(self, number, width):
        self.number, self.width = number, width
        super().__init__(f"{number}x{width}")

    @property
    def vector(self):
        """LLVM's type."""
        return ir.VectorType(ir.DoubleType() if self.number == types.float64 else ir.FloatType(), self.width)


class Mask(types.Type):
    """So many booleans."""

    def __init__(self, width):
        self.width = width
        super().__init__(f"boolx{width}")


LANES = Lanes(types.float32, WIDTH)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, kind.vector)


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), kind.width))


def integers(width, bits=32):
    """LLVM's type of so many integers."""
    return ir.VectorType(ir.IntType(bits), width)


def pattern(lanes):
    """The lanes that a shuffle takes, as LLVM needs them."""
    lanes = list(lanes)
    return ir.Constant(integers(len(lanes)), lanes)


def _common(kinds):
    """The type of an operation on `kinds`: the lanes among them, float64 if there are such."""
    lanes = [kind for kind in kinds if isinstance(kind, Lanes)]
    return next((kind for kind in lanes if kind.number == types.float64), lanes[0] if lanes else LANES)


def _broadcast(context, builder, value, kind, lanes):
    """`value` as `lanes`; a scalar is copied to every lane."""
    if kind == lanes:
        return value
    nothing = ir.Constant(lanes.vector, ir.Undefined)
    first = builder.insert_element(nothing, context.cast(builder, value, kind, lanes.number), ir.IntType(32)(0))
    return builder.shuffle_vector(first, nothing, pattern([0] * lanes.width))


def _generator(emit):
    """A lowering that calls `emit(builder, *vectors)` on lanes or scalars."""

    def generate(context, builder, signature, values):
        lanes = _common(signature.args)
        return emit(builder, *(_broadcast(context, builder, v, k, lanes) for v, k in zip(values, signature.args, strict=True)))

    return generate


def lane_wise(emit):
    """An intrinsic that calls `emit(builder, *vectors)` on lanes or scalars."""
    return lambda *kinds: (_common(kinds)(*kinds), _generator(emit))


def call(name, builder, *vectors):
    """Call LLVM's intrinsic `name` on vectors."""
    kind = vectors[0].type
    suffix = "f64" if kind.element == ir.DoubleType() else "f32"
    signature = ir.FunctionType(kind, [kind] * len(vectors))
    return builder.call(cgutils.get_or_insert_function(builder.module, signature, f"llvm.{name}.v{kind.count}{suffix}"), vectors)


def _operator(symbol, emit, compares=False):
    """Define an operator for operands of which at least one is lanes; its result is such lanes, or a mask if it compares.

    An `overload` would do the same, but numba compiles a function for each pair of types then: a third of all time to compile.
    """

    @type_callable(symbol)
    def type_of(_context):
        def typer(*kinds):
            if any(isinstance(kind, Lanes) for kind in kinds):
                return Mask(_common(kinds).width) if compares else _common(kinds)

        return typer

    for kinds in ((Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes)):
        lower_builtin(symbol, *kinds)(_generator(emit))


_operator(operator.add, lambda builder, a, b: builder.fadd(a, b))
_operator(operator.sub, lambda builder, a, b: builder.fsub(a, b))
_operator(operator.mul, lambda builder, a, b: builder.fmul(a, b))
_operator(operator.truediv, lambda builder, a, b: builder.fdiv(a, b))
_operator(operator.lt, lambda builder, a, b: builder.fcmp_ordered("<", a, b), compares=True)
_operator(operator.gt, lambda builder, a, b: builder.fcmp_ordered(">", a, b), compares=True)
_operator(operator.ge, lambda builder, a, b: builder.fcmp_ordered(">=", a, b), compares=True)
_operator(operator.le, lambda builder, a, b: builder.fcmp_ordered("<=", a, b), compares=True)


@type_callable(operator.neg)
def _type_of_negative(_context):
    return lambda lanes: lanes if isinstance(lanes, Lanes) else None


lower_builtin(operator.neg, Lanes)(_generator(lambda builder, lanes: builder.fneg(lanes)))


@intrinsic
def both(_context, first, second):
    """first and second, for two masks."""
    return first(first, second), lambda context, builder, signature, values: builder.and_(*values)


@intrinsic
def bits(_context, mask):
    """A mask as an integer: bit k is lane k."""

    def generate(context, builder, signature, values):
        return builder.zext(builder.bitcast(values[0], ir.IntType(mask.width)), ir.IntType(64))

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
    return lane_wise(partial(call, "fmuladd"))(a, b, c)


@intrinsic
def minimum(_context, a, b):
    return lane_wise(lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))(a, b)


@intrinsic
def maximum(_context, a, b):
    return lane_wise(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))(a, b)


@intrinsic
def absolute(_context, a):
    return lane_wise(partial(call, "fabs"))(a)


@intrinsic
def sqrt(_context, a):
    return lane_wise(partial(call, "sqrt"))(a)


@intrinsic
def floor(_context, a):
    return lane_wise(partial(call, "floor"))(a)


@intrinsic
def ceil(_context, a):
    return lane_wise(partial(call, "ceil"))(a)


@intrinsic
def broadcast(_context, value):
    """A scalar in every lane."""
    return lane_wise(lambda builder, value: value)(value)


def _plus(steps):
    """An emitter of lanes plus the constants `steps` [16]."""
    constant = ir.Constant(LANES.vector, [float(step) for step in steps])
    return lambda builder, start: builder.fadd(start, constant)


@intrinsic
def across(_context, start):
    """start, a number, plus the column 0..3 of each lane, for lanes that are 4 x 4 pixels, row by row."""
    return lane_wise(_plus(lane % 4 for lane in range(WIDTH)))(start)


@intrinsic
def down(_context, start):
    """start, a number, plus the row 0..3 of each lane, for lanes that are 4 x 4 pixels, row by row."""
    return lane_wise(_plus(lane // 4 for lane in range(WIDTH)))(start)


@intrinsic
def wide(_context, lanes):
    """float32 as float64; any number of lanes."""
    doubles = Lanes(types.float64, lanes.width)
    return doubles(lanes), lambda context, builder, signature, values: builder.fpext(values[0], doubles.vector)


@intrinsic
def narrow(_context, doubles):
    """float64 rounded to float32, infinite where float32 overflows; any number of lanes."""
    lanes = Lanes(types.float32, doubles.width)
    return lanes(doubles), lambda context, builder, signature, values: builder.fptrunc(values[0], lanes.vector)
