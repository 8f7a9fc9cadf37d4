"""Tile-based alpha compositing: splats on the image plane -> image.

SortedSplats are sorted by depth once and binned to tiles in that order. Tiles with lists of similar length are composited together, a
bounded number of (splat, pixel) pairs at a time. The backward pass recomputes each batch instead of storing it, so memory
grows with the batch and not with splats x pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from mipmap_plugin.camera import Camera
from mipmap_plugin.render_settings import RenderSettings

# (splat, pixel) pairs composited at once. About ten float32 tensors of this size are alive together: 0.3 GiB.
BATCH_PAIRS = 1 << 23


@dataclass(frozen=True, eq=False)
class SortedSplats:
    """The M visible splats, front to back, as compositing needs them."""

    means2d: Tensor  # [M, 2] px
    footprints: Tensor  # [M, F], the parameters of `alphas`
    colors: Tensor  # [M, 3]
    least_alpha: Tensor  # [M]; a splat is not drawn on a pixel where its alpha is less
    # (footprints [B, K, 1, F], dx, dy [B, K, P] px from the centers, least [B, K, 1]) -> alpha [B, K, P] of K splats in depth order
    alphas: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
    memory_factor: int = 1  # memory that `alphas` takes, relative to a plain Gaussian


def independent(alpha: Callable[[Tensor, Tensor, Tensor], Tensor], max_alpha: float, gated: bool) -> Callable[..., Tensor]:
    """`SortedSplats.alphas` for splats whose alpha does not depend on the splats in front of them. Alpha is clamped to `max_alpha`.

    gated: the last footprint parameter is the gate of `culls.gate`, 1 for a splat that is drawn and 0 for one that is culled.
    """

    def alphas(footprints: Tensor, dx: Tensor, dy: Tensor, least: Tensor) -> Tensor:
        raw = alpha(footprints, dx, dy)
        return torch.where(raw >= least, (footprints[..., -1] * raw if gated else raw).clamp_max(max_alpha), 0.0)

    return alphas


def composite(splats: SortedSplats, extents: Tensor, camera: Camera, settings: RenderSettings, background: Tensor) -> tuple[Tensor, Tensor]:
    """Composite over `background` [3]. Returns the color [H, W, 3] and the transmittance [H, W].

    `extents` [M, 2]: half-sizes of each splat's bounding box, px.
    """
    tile = settings.tile
    tiles_x, tiles_y = -(-camera.width // tile), -(-camera.height // tile)
    starts, members = bin_tiles(splats.means2d, extents, tiles_x, tiles_y, tile)
    # Empty sums connect the image to the splats in the gradient graph, so that where none is drawn the gradient is 0 and not an error.
    nothing = splats.colors[:0].sum() + splats.means2d[:0].sum() + splats.footprints[:0].sum()
    color = nothing + splats.colors.new_zeros(tiles_x * tiles_y, tile**2, 3)
    transmittance = splats.colors.new_ones(tiles_x * tiles_y, tile**2)
    rounded = background.expand(tiles_x * tiles_y, tile**2, 3)
    filled = int((starts.diff() > 0).sum())
    for tiles, ids in _batches(starts, members, splats.memory_factor * tile**2):
        pixels = _pixel_centers(tiles, tiles_x, tile).to(splats.colors)
        if torch.is_grad_enabled() and len(tiles) < filled:  # to compute the only batch again would save no memory
            batch = checkpoint(_composite_batch, splats, settings.min_transmittance, ids, pixels, use_reentrant=False, preserve_rng_state=False)
        else:
            batch = _composite_batch(splats, settings.min_transmittance, ids, pixels)
        color, transmittance = color.index_copy(0, tiles, batch[0]), transmittance.index_copy(0, tiles, batch[1])
        if settings.picture_step is not None:
            rounded = rounded.index_copy(0, tiles, _composite_rounded(splats, ids, pixels, background, settings.picture_step))
    color = color + transmittance[..., None] * background
    if settings.picture_step is not None:
        color = color + (rounded - color).detach()  # straight-through: the gradient is that of the exact image
    return _untile(color, tiles_x, tile, camera), _untile(transmittance[..., None], tiles_x, tile, camera)[..., 0]


def bin_tiles(means2d: Tensor, extents: Tensor, tiles_x: int, tiles_y: int, tile: int) -> tuple[Tensor, Tensor]:
    """Bin splats to tiles: offsets [tiles + 1] into splat indices [pairs], which keep the order of the splats within each tile."""
    grid = means2d.new_tensor([tiles_x, tiles_y])
    # Clamped before the conversion to integers, which the extent of a splat may overflow.
    low = ((means2d - extents) / tile).floor().clamp_min(0).minimum(grid).long()
    high = ((means2d + extents) / tile).floor().add(1).clamp_min(0).minimum(grid).long()
    span = (high - low).clamp_min(0)
    counts = span[:, 0] * span[:, 1]
    ids = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    nth = torch.arange(len(ids), device=counts.device) - (counts.cumsum(0) - counts)[ids]
    width = span[ids, 0]
    tiles = (low[ids, 1] + nth // width) * tiles_x + low[ids, 0] + nth % width
    order = tiles.argsort(stable=True)
    starts = torch.bincount(tiles, minlength=tiles_x * tiles_y).cumsum(0)
    return torch.cat([starts.new_zeros(1), starts]), ids[order]


def _batches(starts: Tensor, members: Tensor, pixels: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield tiles [B] and their splat indices [B, K], padded with -1. Longest lists first, so that those of one batch have similar length."""
    counts = starts.diff()
    order = counts.argsort(descending=True, stable=True)
    order = order[: int((counts > 0).sum())]
    while len(order):
        longest = int(counts[order[0]])
        take = max(1, BATCH_PAIRS // (longest * pixels))
        tiles, order = order[:take], order[take:]
        slots = torch.arange(longest, device=starts.device)
        inside = slots < counts[tiles][:, None]
        yield tiles, torch.where(inside, members[(starts[tiles][:, None] + slots).clamp_max(len(members) - 1)], -1)


def _composite_batch(splats: SortedSplats, min_transmittance: float, ids: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Composite one batch of tiles: ids [B, K], pixels [B, P, 2] -> color [B, P, 3], transmittance [B, P]."""
    alpha, ids = _alpha(splats, ids, pixels)
    after = torch.cumprod(1 - alpha, dim=1)
    open_ = after.detach() >= min_transmittance  # a pixel stops before the splat that would bring it below
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    weights = torch.where(open_, before * alpha, 0.0)
    transmittance = torch.where(open_, 1 - alpha, 1.0).prod(dim=1)
    return torch.einsum("bkp,bkc->bpc", weights, splats.colors[ids]), transmittance


def _alpha(splats: SortedSplats, ids: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Alpha [B, K, P] of the splats `ids` [B, K] at `pixels` [B, P, 2], 0 where the id is -1; and the ids with -1 replaced by 0."""
    present = (ids >= 0)[:, :, None]
    ids = ids.clamp_min(0)
    dx, dy = (pixels[:, None] - splats.means2d[ids][:, :, None]).unbind(-1)  # [B, K, P]
    alphas = splats.alphas(splats.footprints[ids][:, :, None], dx, dy, splats.least_alpha[ids][:, :, None])
    return torch.where(present, alphas, 0.0), ids


@torch.no_grad()
def _composite_rounded(splats: SortedSplats, ids: Tensor, pixels: Tensor, background: Tensor, step: float) -> Tensor:
    """Composite back to front over `background` into [B, P, 3], clamped to 0..1 and rounded to multiples of `step` after each splat."""
    alpha, ids = _alpha(splats, ids, pixels)
    color = background.expand(*pixels.shape[:2], 3)
    for k in reversed(range(ids.shape[1])):
        added = (alpha[:, k, :, None] * splats.colors[ids[:, k]][:, None]).clamp(0, 1)
        after = ((added + (1 - alpha[:, k, :, None]) * color) / step).round() * step
        color = torch.where(alpha[:, k, :, None] > 0, after.clamp(0, 1), color)
    return color


def _pixel_centers(tiles: Tensor, tiles_x: int, tile: int) -> Tensor:
    """Pixel centers of each tile, [B, P, 2] px, row by row."""
    step = torch.arange(tile, device=tiles.device) + 0.5
    inside = torch.stack(torch.meshgrid(step, step, indexing="xy"), -1).flatten(0, 1)
    corner = torch.stack([tiles % tiles_x, tiles // tiles_x], -1) * tile
    return corner[:, None] + inside


def _untile(tiles: Tensor, tiles_x: int, tile: int, camera: Camera) -> Tensor:
    """Assemble tiles [tiles, tile², C] into an image [H, W, C]."""
    grid: Tensor = tiles.unflatten(1, (tile, tile)).unflatten(0, (-1, tiles_x))
    return grid.transpose(1, 2).flatten(2, 3).flatten(0, 1)[: camera.height, : camera.width]
