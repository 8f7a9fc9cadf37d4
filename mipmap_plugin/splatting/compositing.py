"""Tiles, and front-to-back "over" inside each: splats on the image plane -> image.

Splats are sorted once by depth and binned to tiles in that order. Tiles with lists of like length are composited together, a
bounded number of (splat, pixel) pairs at a time; each such batch is recomputed in the backward pass instead of remembered, so
memory grows with the batch and not with splats x pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import MAX_ALPHA, RenderSettings

# (splat, pixel) pairs composited at once: about ten tensors of this many float32 live together, 0.3 GiB.
BATCH_PAIRS = 1 << 23


@dataclass(frozen=True, eq=False)
class Splats:
    """What compositing needs of the splats that can be seen, sorted front to back."""

    means2d: Tensor  # [M, 2] px
    feet: Tensor  # [M, F], what `alpha` needs of each
    colors: Tensor  # [M, 3]
    least_alpha: Tensor  # [M], below it a splat is not drawn
    # (feet [B, K, 1, F], dx, dy [B, K, P] px from the centers, least [B, K, 1]) -> alpha [B, K, P] of K splats one behind the other
    alphas: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
    room: int = 1  # how many times the memory of a Gaussian `alphas` takes


def alone(
    alpha: Callable[[Tensor, Tensor, Tensor], Tensor], most: float = MAX_ALPHA, gated: bool = False
) -> Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]:
    """`Splats.alphas` of splats whose alpha does not depend on those in front, and is at most `most`.

    gated: the last of what `alpha` needs is the share of a splat that is drawn, 1, or 0 where it is culled.
    """

    def alphas(feet: Tensor, dx: Tensor, dy: Tensor, least: Tensor) -> Tensor:
        found = alpha(feet, dx, dy)
        drawn = found.clamp_max(most) >= least
        return torch.where(drawn, (feet[..., -1] * found if gated else found).clamp_max(most), 0.0)

    return alphas


def composite(
    splats: Splats, extents: Tensor, camera: Camera, settings: RenderSettings, background: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Front-to-back over `background` [3], black by default: color [H, W, 3] and transmittance [H, W]. `extents` [M, 2]: half-sizes in px."""
    tile = settings.tile
    columns, rows = -(-camera.width // tile), -(-camera.height // tile)
    starts, members = bin_tiles(splats.means2d, extents, columns, rows, tile)
    # The empty sum ties the image to the splats even where none is drawn: its gradient is then 0, not an error.
    color = splats.colors[:0].sum() + splats.colors.new_zeros(rows * columns, tile**2, 3)
    through = splats.colors.new_ones(rows * columns, tile**2)
    background = splats.colors.new_zeros(3) if background is None else background
    picture = background.expand(rows * columns, tile**2, 3)
    for tiles, ids in _batches(starts, members, splats.room * tile**2):
        pixels = _pixel_centers(tiles, columns, tile).to(splats.colors)
        if torch.is_grad_enabled():
            batch = checkpoint(_composite_batch, splats, settings.min_transmittance, ids, pixels, use_reentrant=False, preserve_rng_state=False)
        else:
            batch = _composite_batch(splats, settings.min_transmittance, ids, pixels)
        color, through = color.index_copy(0, tiles, batch[0]), through.index_copy(0, tiles, batch[1])
        if settings.picture_step is not None:
            picture = picture.index_copy(0, tiles, _rounded(splats, ids, pixels, background, settings.picture_step))
    color = color + through[..., None] * background
    if settings.picture_step is not None:
        color = color + (picture - color).detach()
    return _untile(color, columns, tile, camera), _untile(through[..., None], columns, tile, camera)[..., 0]


def bin_tiles(means2d: Tensor, extents: Tensor, columns: int, rows: int, tile: int) -> tuple[Tensor, Tensor]:
    """Which splats touch which tile: offsets [tiles + 1] into members [pairs], in the splats' order within each tile."""
    grid = means2d.new_tensor([columns, rows])
    # Clamped while still floating-point: a splat may reach further than an integer can count.
    low = ((means2d - extents) / tile).floor().clamp_min(0).minimum(grid).long()
    high = ((means2d + extents) / tile).floor().add(1).clamp_min(0).minimum(grid).long()
    span = (high - low).clamp_min(0)
    counts = span[:, 0] * span[:, 1]
    ids = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    nth = torch.arange(len(ids), device=counts.device) - (counts.cumsum(0) - counts)[ids]
    width = span[ids, 0]
    tiles = (low[ids, 1] + nth // width) * columns + low[ids, 0] + nth % width
    order = tiles.argsort(stable=True)
    starts = torch.bincount(tiles, minlength=rows * columns).cumsum(0)
    return torch.cat([starts.new_zeros(1), starts]), ids[order]


def _batches(starts: Tensor, members: Tensor, pixels: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Tiles [B] and their padded lists [B, K] (-1: none), longest first, so that lists of one batch are of like length."""
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


def _composite_batch(splats: Splats, stop: float, ids: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """One batch of tiles: ids [B, K], pixels [B, P, 2] -> color [B, P, 3], transmittance [B, P]."""
    alpha, ids = _alpha(splats, ids, pixels)
    after = torch.cumprod(1 - alpha, dim=1)
    open_ = after.detach() >= stop  # a pixel stops before the splat that would finish it
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    weights = torch.where(open_, before * alpha, 0.0)
    through = torch.where(open_, 1 - alpha, 1.0).prod(dim=1)
    return torch.einsum("bkp,bkc->bpc", weights, splats.colors[ids]), through


def _alpha(splats: Splats, ids: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Alpha [B, K, P] of the splats `ids` [B, K] at `pixels` [B, P, 2], 0 where there is none (-1); and the ids, 0 in place of none."""
    shown = (ids >= 0)[:, :, None]
    ids = ids.clamp_min(0)
    dx, dy = (pixels[:, None] - splats.means2d[ids][:, :, None]).unbind(-1)  # [B, K, P]
    alphas = splats.alphas(splats.feet[ids][:, :, None], dx, dy, splats.least_alpha[ids][:, :, None])
    return torch.where(shown, alphas, 0.0), ids


@torch.no_grad()
def _rounded(splats: Splats, ids: Tensor, pixels: Tensor, background: Tensor, step: float) -> Tensor:
    """[B, P, 3]: splats laid over `background` back to front, the picture within 0..1 and rounded to multiples of `step` after each."""
    alpha, ids = _alpha(splats, ids, pixels)
    picture = background.expand(*pixels.shape[:2], 3)
    for k in reversed(range(ids.shape[1])):
        light = (alpha[:, k, :, None] * splats.colors[ids[:, k]][:, None]).clamp(0, 1)
        after = ((light + (1 - alpha[:, k, :, None]) * picture) / step).round() * step
        picture = torch.where(alpha[:, k, :, None] > 0, after.clamp(0, 1), picture)
    return picture


def _pixel_centers(tiles: Tensor, columns: int, tile: int) -> Tensor:
    """[B, P, 2] px, row by row inside each tile."""
    step = torch.arange(tile, device=tiles.device) + 0.5
    inside = torch.stack(torch.meshgrid(step, step, indexing="xy"), -1).flatten(0, 1)
    corner = torch.stack([tiles % columns, tiles // columns], -1) * tile
    return corner[:, None] + inside


def _untile(tiles: Tensor, columns: int, tile: int, camera: Camera) -> Tensor:
    """[tiles, tile², C] -> [H, W, C]."""
    grid = tiles.unflatten(1, (tile, tile)).unflatten(0, (-1, columns))
    return grid.transpose(1, 2).flatten(2, 3).flatten(0, 1)[: camera.height, : camera.width]
