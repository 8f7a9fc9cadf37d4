"""Exponentials and logarithms of lanes; numba's own take scalars only."""

# numba redefines calls and operators.
# mypy: ignore-errors

import math

from llvmlite import ir
from numba.extending import intrinsic

from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.lanes import INTS32, INTS64, VECTOR32, VECTOR64, WIDTH, fma, lane_wise, maximum, narrow, select, wide


@intrinsic
def _add_to_exponent(_context, lanes, rounded):
    """lanes · 2^n, with n in the low bits of `rounded` as in `exp2`."""

    def emit(builder, lanes, rounded):
        shift = ir.Constant(INTS32, [23] * WIDTH)
        bits = builder.add(builder.bitcast(lanes, INTS32), builder.shl(builder.bitcast(rounded, INTS32), shift))
        return builder.bitcast(bits, VECTOR32)

    return lane_wise(emit)(lanes, rounded)


# 1.5 · 2^23: adding it to a float32 leaves the nearest integer in the low bits.
_ROUNDER = 12582912.0


@inner
def exp2(power):
    """2^power, relative error 1e-7, for -126 < power < 127; undefined outside."""
    rounded = power + _ROUNDER
    remainder = power - (rounded - _ROUNDER)  # -0.5 .. 0.5
    series = fma(remainder, 0.00132647272, 0.00967151264)  # minimax in relative error, exactly 1 at 0
    series = fma(series, remainder, 0.0555073374)
    series = fma(series, remainder, 0.240222421)
    series = fma(series, remainder, 0.693146978)
    series = fma(series, remainder, 1.0)
    return _add_to_exponent(series, rounded)


@intrinsic
def _exponent(_context, lanes):
    """The exponents of positive float64."""

    def emit(builder, lanes):
        bits = builder.lshr(builder.bitcast(lanes, INTS64), ir.Constant(INTS64, [52] * WIDTH))
        return builder.sitofp(builder.sub(bits, ir.Constant(INTS64, [1023] * WIDTH)), VECTOR64)

    return lane_wise(emit)(lanes)


@intrinsic
def _mantissa(_context, lanes):
    """The mantissas of positive float64, 1 .. 2."""

    def emit(builder, lanes):
        digits = builder.and_(builder.bitcast(lanes, INTS64), ir.Constant(INTS64, [(1 << 52) - 1] * WIDTH))
        return builder.bitcast(builder.or_(digits, ir.Constant(INTS64, [1023 << 52] * WIDTH)), VECTOR64)

    return lane_wise(emit)(lanes)


@inner
def log2(x):
    """The logarithm of positive, normal float64, error 1e-10: twice the series of artanh((m - 1)/(m + 1))."""
    m, n = _mantissa(x), _exponent(x)
    large = m > math.sqrt(2)
    m, n = select(large, m * 0.5, m), select(large, n + 1, n)
    s = (m - 1) / (m + 1)
    ss = s * s
    series = fma(ss, 1 / 13, 1 / 11)
    series = fma(series, ss, 1 / 9)
    series = fma(series, ss, 1 / 7)
    series = fma(series, ss, 1 / 5)
    series = fma(series, ss, 1 / 3)
    series = fma(series, ss, 1.0)
    return fma(series, s * (2 / math.log(2)), n)


@inner
def tanh(x):
    """The hyperbolic tangent of float64 lanes of at least 0, relative error 3e-7."""
    xx = x * x
    series = fma(xx, 62 / 2835, -17 / 315)
    series = fma(series, xx, 2 / 15)
    series = fma(series, xx, -1 / 3)
    series = fma(series, xx, 1.0) * x
    decay = wide(exp2(narrow(maximum(x * (-2 / math.log(2)), -125.0))))
    return select(x < 0.25, series, (1 - decay) / (1 + decay))
