"""A step of Adam over the raw parameters of 3DGS, from the gradients of the activated splats: some rows at a time, while they are in the cache."""

# numba redefines calls and operators.
# mypy: ignore-errors

import math

import numpy as np

from mipmap_plugin.backends.cpu_kernels import inner, kernel
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, sqrt
from mipmap_plugin.backends.cpu_kernels.memory import load, pointer, store


@kernel
def step(start, stop, splats, grads, raw, firsts, seconds, rates, settings):
    """Move the rows start..stop of the raw parameters, whose moments are `firsts` and `seconds`; row 0 of `grads` is that of splat `start`.

    Afterwards `grads` has the gradients of the raw parameters. rates: [16 · columns] each, those of 16 rows.
    """
    through_activations(start, stop, splats, grads, raw)
    move(start, stop, grads.means, raw.means, firsts.means, seconds.means, rates.means, settings)
    move(start, stop, grads.quats, raw.quats, firsts.quats, seconds.quats, rates.quats, settings)
    move(start, stop, grads.scales, raw.scales, firsts.scales, seconds.scales, rates.scales, settings)
    move(start, stop, grads.opacities, raw.opacities, firsts.opacities, seconds.opacities, rates.opacities, settings)
    move(start, stop, grads.sh, raw.sh, firsts.sh, seconds.sh, rates.sh, settings)


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
        along, squared = 0.0, 0.0
        for k in range(4):
            along += d_quats[4 * i + k] * quats[4 * (start + i) + k]
            squared += np.float64(raw_quats[4 * (start + i) + k]) ** 2
        per_norm = 1 / math.sqrt(squared) if squared > 0 else 0.0  # a zero quaternion is drawn as the identity, whatever its neighbors are
        for k in range(4):
            d_quats[4 * i + k] = (d_quats[4 * i + k] - along * quats[4 * (start + i) + k]) * per_norm


@inner
def move(start, stop, grads, raw, first, second, rates, settings):
    """Adam on the rows start..stop of one parameter. settings: 1 - beta1, 1 - beta2, 1 / sqrt(1 - beta2^t) and epsilon."""
    columns = raw.size // len(raw)
    d, p, m, v, rate = pointer(grads), pointer(raw), pointer(first), pointer(second), pointer(rates)
    new_first, new_second, correction, eps = settings
    at, count, of_rate = start * columns, (stop - start) * columns, 0
    whole = count - count % WIDTH
    for i in range(0, whole, WIDTH):
        g = load(d, i)
        mean, square = load(m, at + i), load(v, at + i)
        mean = mean + (g - mean) * new_first
        square = square + (g * g - square) * new_second
        store(m, at + i, mean)
        store(v, at + i, square)
        store(p, at + i, load(p, at + i) - load(rate, of_rate) * mean / (sqrt(square) * correction + eps))
        of_rate = of_rate + WIDTH if of_rate + WIDTH < len(rates) else 0
    for i in range(whole, count):
        m[at + i] += (d[i] - m[at + i]) * new_first
        v[at + i] += (d[i] * d[i] - v[at + i]) * new_second
        p[at + i] -= rate[of_rate + i - whole] * m[at + i] / (np.float32(math.sqrt(v[at + i])) * correction + eps)
