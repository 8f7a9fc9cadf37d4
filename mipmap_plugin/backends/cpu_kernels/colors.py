"""The colors of 16 splats in a view's direction, limited and rounded as the view does."""

# numba redefines calls and operators.
# mypy: ignore-errors

import numpy as np

from mipmap_plugin.backends.cpu_kernels import inner, layout
from mipmap_plugin.backends.cpu_kernels.blocks import get, put
from mipmap_plugin.backends.cpu_kernels.columns import apart, load_three
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH, absolute, both, lowest_bit, maximum, minimum
from mipmap_plugin.backends.cpu_kernels.layout import HUGE
from mipmap_plugin.backends.cpu_kernels.memory import load
from mipmap_plugin.backends.cpu_kernels.sums import total

# The least positive color, and the factor that makes the largest color slightly less, in float32.
MIN_COLOR, BELOW_MAX = 1e-30, 1 - 1e-7


@inner
def fill_colors(visible, at, stride, view, third, sh, bands, bands_of, block):
    """Write the colors of the splats whose bit is set; those of the first begin at sh[at]."""
    while visible != 0:
        lane = lowest_bit(visible)
        visible &= visible - 1
        red, green, blue = color_of(at + lane * stride, lane, view, third, sh, bands, bands_of)
        block[layout.RED * WIDTH + lane], block[layout.GREEN * WIDTH + lane], block[layout.BLUE * WIDTH + lane] = red, green, blue


@inner
def clamp_colors(view, block):
    """Limit and round the colors as the view does; returns which were finite."""
    red, green = clamp_channel(view, 0, layout.RED, block), clamp_channel(view, 1, layout.GREEN, block)
    return both(both(red, green), clamp_channel(view, 2, layout.BLUE, block))


@inner
def clamp_channel(view, channel, field, block):
    """`clamp_colors`, for one channel."""
    color, step = get(block, field), view.color_steps[channel]
    put(block, field, minimum(maximum(color, 0), view.max_color))
    if step > 0:
        quantize(step, np.float32(view.max_color), field * WIDTH, block)
    return absolute(color) < HUGE


@inner
def quantize(step, largest, at, block):
    """Round the 16 numbers from block[at] on to multiples of `step`; those above 0 and below `largest` stay so, for else they had no gradient."""
    for lane in range(at, at + WIDTH):
        if 0 < block[lane] < largest:
            block[lane] = np.float32(max(min(round(block[lane] / step) * step, largest * BELOW_MAX), MIN_COLOR))


@inner
def color_of(at, lane, view, third, sh, bands, bands_of):
    """The color of the splat in a lane, in this view's direction. Its coefficients start at sh[at]; `bands_of`, if `third`: bands lane by lane."""
    half = np.float32(0.5)
    red, green, blue = half, half, half
    if third is not None:
        band = load(bands_of, lane * WIDTH)
        reds, greens, blues = apart(load_three(sh, at))
        return half + total(band * reds), half + total(band * greens), half + total(band * blues)
    for j in range((view.sh_degree + 1) ** 2):
        band = bands[j * WIDTH + lane]
        red += band * sh[at + 3 * j]
        green += band * sh[at + 3 * j + 1]
        blue += band * sh[at + 3 * j + 2]
    return red, green, blue
