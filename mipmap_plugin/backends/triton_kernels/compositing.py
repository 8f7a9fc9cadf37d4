"""Compositing: one program renders one tile, splat by splat, front to back, until no pixel is open.

A program is a single warp, whose lanes hold up to two pixels each: a splat's record is read once for the tile, and sums over it need no barrier.
"""

from __future__ import annotations

import triton
import triton.language as tl

from mipmap_plugin import render_settings
from mipmap_plugin.backends.triton_kernels import views
from mipmap_plugin.backends.triton_kernels.records import RECORD

USUAL_MAX_ALPHA = tl.constexpr(render_settings.MAX_ALPHA)
MIN_ALPHA, MIN_TRANSMITTANCE, MAX_ALPHA = views.MIN_ALPHA, views.MIN_TRANSMITTANCE, views.MAX_ALPHA
W_END, LOG2_W_CUT = views.W_END, views.LOG2_W_CUT
RED, GREEN, BLUE = views.RED, views.GREEN, views.BLUE
WIDTH, HEIGHT, TILES_X, NUMBERS = views.WIDTH, views.HEIGHT, views.TILES_X, views.NUMBERS


@triton.jit
def pixels(view, most_pixels, TILE: tl.constexpr):
    """This program's pixels [TILE²] in its view: their centers in px, their index in the images, and whether they lie inside."""
    tile, tiles_x = tl.program_id(0), tl.load(view + TILES_X).to(tl.int32)
    width, height = tl.load(view + WIDTH).to(tl.int32), tl.load(view + HEIGHT).to(tl.int32)
    nth = tl.arange(0, TILE * TILE)
    x, y = tile % tiles_x * TILE + nth % TILE, tile // tiles_x * TILE + nth // TILE
    return x + 0.5, y + 0.5, tl.program_id(1).to(tl.int64) * most_pixels + y * width + x, (x < width) & (y < height)


@triton.jit
def slots(tile_offsets):
    """Where the list of this program's tile begins and ends."""
    tile = tile_offsets + tl.program_id(1) * tl.num_programs(0) + tl.program_id(0)
    return tl.load(tile), tl.load(tile + 1)


@triton.jit
def largest(values):
    """The bits of the largest of `values`, none of which is negative: the maximum of integers over a warp is one instruction."""
    return tl.max(values.to(tl.int32, bitcast=True), axis=0)


@triton.jit
def record_at(records, slot, end):
    """The nine numbers in a slot; past the `end` those of a splat that is not there."""
    row, valid = records + slot * RECORD, slot < end
    x, y, along, shear = tl.load(row, valid, 0.0), tl.load(row + 1, valid, 0.0), tl.load(row + 2, valid, 0.0), tl.load(row + 3, valid, 0.0)
    across, log2_opacity = tl.load(row + 4, valid, 0.0), tl.load(row + 5, valid, float("-inf"))
    red, green, blue = tl.load(row + 6, valid, 0.0), tl.load(row + 7, valid, 0.0), tl.load(row + 8, valid, 0.0)
    return x, y, along, shear, across, log2_opacity, red, green, blue


@triton.jit
def cut_offs(view):
    """The least alpha and, for other settings than the usual ones, the largest, and the weights where splats are cut off and where they end."""
    return tl.load(view + MIN_ALPHA), tl.load(view + MAX_ALPHA), tl.load(view + LOG2_W_CUT), tl.load(view + W_END)


@triton.jit
def is_culled(record):
    """Whether a splat is listed for its gradient only."""
    return record[2] > 0


@triton.jit
def alpha_at(record, px, py, limits, VIEWER: tl.constexpr):
    """For the pixels [P]: dy, u = dx - shear · dy, and alpha before and after its cut-offs.

    VIEWER: whether the settings are not the usual ones. Alpha of a culled splat is what it would be without culling and without a largest one.
    """
    x, y, along, shear, across, log2_opacity, _red, _green, _blue = record
    least, most, cut, end = limits
    dy = py - y
    u = px - x - shear * dy
    if VIEWER:
        power = -tl.abs(along) * dy * dy + across * u * u
        raw = tl.exp2(power + log2_opacity) - end * tl.exp2(log2_opacity)
        alpha = tl.minimum(raw, tl.where(is_culled(record), float("inf"), most))
        alpha = tl.where((raw >= least) & (power >= cut), alpha, 0.0)
    else:
        raw = tl.exp2(along * dy * dy + across * u * u + log2_opacity)
        alpha = tl.where(raw >= least, tl.minimum(raw, USUAL_MAX_ALPHA), 0.0)
    return dy, u, raw, alpha


@triton.jit
def drawn(record, alpha, VIEWER: tl.constexpr):
    """Alpha of a splat, or 0 if it is culled."""
    if VIEWER:
        alpha = tl.where(is_culled(record), 0.0, alpha)
    return alpha


@triton.jit
def blended(records, slot, end, px, py, running, stop, limits, VIEWER: tl.constexpr):
    """The record in a slot, its blend weights [P], which are 0 in finished pixels, and the transmittance `running` [P] behind it."""
    record = record_at(records, slot, end)
    _dy, _u, _raw, alpha = alpha_at(record, px, py, limits, VIEWER)
    alpha = drawn(record, alpha, VIEWER)
    behind = running * (1 - alpha)
    return record, tl.where(behind >= stop, running * alpha, 0.0), behind


@triton.jit(do_not_specialize=["most_pixels"])
def composite_kernel(
    records, tile_offsets, shots, images, transmittances, most_pixels, TILE: tl.constexpr, BATCH: tl.constexpr, VIEWER: tl.constexpr
):
    """Composite one tile of one view into `images` and `transmittances`."""
    view = shots + tl.program_id(1) * NUMBERS
    px, py, at, inside = pixels(view, most_pixels, TILE)
    slot, end = slots(tile_offsets)
    limits, stop = cut_offs(view), tl.load(view + MIN_TRANSMITTANCE)
    running = tl.where(inside, 1.0, 0.0)  # transmittance if pixels never stopped; once it is below `stop`, the pixel is finished
    transmittance = tl.zeros_like(running) + 1
    red, green, blue = tl.zeros_like(running), tl.zeros_like(running), tl.zeros_like(running)
    while (slot < end) & (largest(running) >= stop.to(tl.int32, bitcast=True)):
        for _ in tl.static_range(BATCH):
            record, weight, behind = blended(records, slot, end, px, py, running, stop, limits, VIEWER)
            red, green, blue = red + weight * record[6], green + weight * record[7], blue + weight * record[8]
            transmittance = tl.where(behind >= stop, behind, transmittance)
            running = behind
            slot += 1
    tl.store(images + 3 * at, red + transmittance * tl.load(view + RED), inside)
    tl.store(images + 3 * at + 1, green + transmittance * tl.load(view + GREEN), inside)
    tl.store(images + 3 * at + 2, blue + transmittance * tl.load(view + BLUE), inside)
    tl.store(transmittances + at, transmittance, inside)
