"""Exponentials and logarithms of lanes; numba's own take scalars only."""

# numba redefines calls and operators.
# mypy: ignore-errors

import math

from llvmlite import ir
from numba.extending import intrinsic

from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.lanes import fma, integers, lane_wise, maximum, narrow, select, wide

# The logarithm of e to base 2, and half of it: exp(-q/2) = 2^(-HALF_LOG2E · q).
LOG2E, HALF_LOG2E = 1 / math.log(2), 0.5 / math.log(2)

# Powers of two, positive and negative, within which `exp2` is defined.
LARGEST_POWER = 125.0

# 1.5 · 2^23: adding it to a float32 leaves the nearest integer in the low bits, and subtracting it again rounds to that integer.
ROUNDER = 12582912.0


def _all(ints, number):
    """The same integer in every lane."""
    return ir.Constant(ints, [number] * ints.count)


@intrinsic
def _add_to_exponent(_context, lanes, rounded):
    """lanes · 2^n, with n in the low bits of `rounded` as in `exp2`."""

    def emit(builder, lanes, rounded):
        ints = integers(lanes.type.count)
        bits = builder.add(builder.bitcast(lanes, ints), builder.shl(builder.bitcast(rounded, ints), _all(ints, 23)))
        return builder.bitcast(bits, lanes.type)

    return lane_wise(emit)(lanes, rounded)


@inner
def exp2(power):
    """2^power, relative error 1e-7, for -126 < power < 127; undefined outside."""
    rounded = power + ROUNDER
    remainder = power - (rounded - ROUNDER)  # -0.5 .. 0.5
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
        ints = integers(lanes.type.count, 64)
        bits = builder.lshr(builder.bitcast(lanes, ints), _all(ints, 52))
        return builder.sitofp(builder.sub(bits, _all(ints, 1023)), lanes.type)

    return lane_wise(emit)(lanes)


@intrinsic
def _mantissa(_context, lanes):
    """The mantissas of positive float64, 1 .. 2."""

    def emit(builder, lanes):
        ints = integers(lanes.type.count, 64)
        digits = builder.and_(builder.bitcast(lanes, ints), _all(ints, (1 << 52) - 1))
        return builder.bitcast(builder.or_(digits, _all(ints, 1023 << 52)), lanes.type)

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
    decay = wide(exp2(narrow(maximum(x * (-2 / math.log(2)), 0 - LARGEST_POWER))))
    return select(x < 0.25, series, (1 - decay) / (1 + decay))
