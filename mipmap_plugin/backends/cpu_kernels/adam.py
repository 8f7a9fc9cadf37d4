"""A step of Adam over the raw parameters of 3DGS, from the gradients of the activated splats: some rows at a time, while they are in the cache."""

# numba redefines calls and operators.
# mypy: ignore-errors

import math

import numpy as np
from numba import types

from mipmap_plugin.backends.cpu_kernels import inner, kernel
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, maximum, minimum, sqrt
from mipmap_plugin.backends.cpu_kernels.memory import load, pointer, scratch, store
from mipmap_plugin.backends.cpu_kernels.powers import LARGEST_POWER, LOG2E, exp2
from mipmap_plugin.splatting.rotations import LEAST_QUATERNION

new_rest = scratch(WIDTH, types.float32)


@kernel
def step(start, stop, splats, grads, raw, firsts, seconds, rates, settings):
    """Move the rows start..stop of the raw parameters, whose moments are `firsts` and `seconds`; row 0 of `grads` is that of splat `start`.

    Afterwards `splats` are those of the moved parameters, and `grads` has the gradients of these. rates: [16 · columns] each, those of 16 rows.
    """
    through_activations(start, stop, splats, grads, raw)
    bands = 3 * raw.sh.shape[1]
    move(start, stop, 3, moved(grads.means, raw.means, firsts.means, seconds.means, rates.means), settings)
    move(start, stop, 4, moved(grads.quats, raw.quats, firsts.quats, seconds.quats, rates.quats), settings)
    move(start, stop, 3, moved(grads.scales, raw.scales, firsts.scales, seconds.scales, rates.scales), settings)
    move(start, stop, 1, moved(grads.opacities, raw.opacities, firsts.opacities, seconds.opacities, rates.opacities), settings)
    move(start, stop, bands, moved(grads.sh, raw.sh, firsts.sh, seconds.sh, rates.sh), settings)
    activate(start, stop, raw, splats)


@inner
def through_activations(start, stop, splats, grads, raw):
    """Replace gradients of scales, opacities and unit quaternions by those of their logarithms, logits and quaternions of any norm."""
    d_scales, d_opacities, d_quats = pointer(grads.scales), pointer(grads.opacities), pointer(grads.quats)
    scales, opacities, quats, raw_quats = pointer(splats.scales), pointer(splats.opacities), pointer(splats.quats), pointer(raw.quats)
    for i in range(3 * (stop - start)):
        d_scales[i] *= scales[3 * start + i]
    for i in range(stop - start):
        opacity = opacities[start + i]
        d_opacities[i] *= opacity * (np.float32(1) - opacity)
        along, per_norm = 0.0, per_norm_of(raw_quats, start + i)
        for k in range(4):
            along += d_quats[4 * i + k] * quats[4 * (start + i) + k]
        for k in range(4):
            d_quats[4 * i + k] = (d_quats[4 * i + k] - along * quats[4 * (start + i) + k]) * per_norm


@inner
def moved(grads, raw, first, second, rates):
    """The arrays of one parameter as pointers, so that `move` is compiled once for all."""
    return pointer(grads), pointer(raw), pointer(first), pointer(second), pointer(rates)


@inner
def move(start, stop, columns, arrays, settings):
    """Adam on the rows start..stop of one parameter. settings: 1 - beta1, 1 - beta2, what the step
    counts of the newest gradient besides the first moment, 1 / sqrt(1 - beta2^t) and epsilon.
    """
    d, p, m, v, rate = arrays
    new_first, new_second, newest, correction, eps = settings
    at, count, of_rate = start * columns, (stop - start) * columns, 0
    whole = count - count % WIDTH
    for i in range(0, whole, WIDTH):
        g = load(d, i)
        mean, square = load(m, at + i), load(v, at + i)
        mean = mean + (g - mean) * new_first
        square = square + (g * g - square) * new_second
        store(m, at + i, mean)
        store(v, at + i, square)
        store(p, at + i, load(p, at + i) - load(rate, of_rate) * (mean + (g - mean) * newest) / (sqrt(square) * correction + eps))
        of_rate = of_rate + WIDTH if of_rate + WIDTH < WIDTH * columns else 0
    for i in range(whole, count):
        m[at + i] += (d[i] - m[at + i]) * new_first
        v[at + i] += (d[i] * d[i] - v[at + i]) * new_second
        mean = m[at + i] + (d[i] - m[at + i]) * newest
        p[at + i] -= rate[of_rate + i - whole] * mean / (np.float32(math.sqrt(v[at + i])) * correction + eps)


@kernel
def activate_rows(start, stop, raw, splats):
    """Fill the rows start..stop of the activated splats from those of the raw parameters; both share means and coefficients."""
    activate(start, stop, raw, splats)


@inner
def activate(start, stop, raw, splats):
    """Scales, opacities and unit quaternions from their logarithms, logits and quaternions of any norm."""
    logs, scales, logits, opacities = pointer(raw.scales), pointer(splats.scales), pointer(raw.opacities), pointer(splats.opacities)
    quats, units, rest = pointer(raw.quats), pointer(splats.quats), new_rest()
    for i in range(3 * start, 3 * stop, WIDTH):
        store_some(scales, i, min(WIDTH, 3 * stop - i), exponential(load_some(logs, i, min(WIDTH, 3 * stop - i), rest)), rest)
    for i in range(start, stop, WIDTH):
        size = min(WIDTH, stop - i)
        store_some(opacities, i, size, 1 / (1 + exponential(0 - load_some(logits, i, size, rest))), rest)
    for i in range(start, stop):
        per_norm = per_norm_of(quats, i)
        for k in range(4):
            units[4 * i + k] = quats[4 * i + k] * per_norm
        if per_norm == 0:
            units[4 * i] = 1


@inner
def per_norm_of(quats, i):
    """1 / norm of a quaternion; 0 for one that is treated as zero, which is the identity, whatever its neighbors are."""
    largest, squared = 0.0, 0.0
    for k in range(4):
        largest = max(largest, abs(np.float64(quats[4 * i + k])))
        squared += np.float64(quats[4 * i + k]) ** 2
    return 1 / math.sqrt(squared) if largest >= LEAST_QUATERNION else 0.0


@inner
def load_some(array, at, size, rest):
    """As `load`, but of `size` numbers at most: all are computed alike, so that they do not depend on where a thread's rows end."""
    if size == WIDTH:
        return load(array, at)
    for k in range(size):
        rest[k] = array[at + k]
    return load(rest, 0)


@inner
def store_some(array, at, size, lanes, rest):
    """Store the first `size` lanes."""
    if size == WIDTH:
        store(array, at, lanes)
    else:
        store(rest, 0, lanes)
        for k in range(size):
            array[at + k] = rest[k]


@inner
def exponential(lanes):
    """e^lanes; scales and opacities beyond what `exp2` is defined for are not drawn any differently."""
    return exp2(minimum(maximum(lanes * LOG2E, 0 - LARGEST_POWER), LARGEST_POWER))
