"""gsplat's torch twins of its CUDA kernels as a backend: a yardstick that pip installs everywhere, to carry ratios between machines.

Projection, covariances and SH are gsplat's own code (`gsplat.cuda._torch_impl`, 1.5.3). Its compositor needs CUDA even in torch, so
that two parts are stand-ins, written plainly: finding the (splat, pixel) pairs that touch, tile by tile and without gradients,
in place of `rasterize_to_indices_in_range`; and blending them over flat lists with autograd, in place of nerfacc's kernels in
`accumulate`. The largest alpha is 0.99, as in 3DGS and gsplat 1.6 (1.5.3 has 0.999), so that every backend draws the same image.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
from typing import NamedTuple

import torch
from torch import Tensor

from mipmap_plugin.backends.base import API_VERSION, Capabilities, Needs, Rendered
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import BackendUnavailable
from mipmap_plugin.gaussians import Gaussians

# 3DGS's constants.
MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4

TILE = 16  # px


class Flat(NamedTuple):
    """Splats on the image plane, as gsplat projects them."""

    radii: Tensor  # [N, 2] px, 0: not drawn
    means: Tensor  # [N, 2] px
    depths: Tensor  # [N]
    conics: Tensor  # [N, 3] 1/px², the inverse covariance's xx, xy, yy
    opacities: Tensor  # [N]


class GsplatTwins:
    name = "gsplat-twins"
    api_version = API_VERSION
    speed = -1  # never the one that `auto` takes
    capabilities = Capabilities(
        devices=frozenset({"cpu"}), dtypes=frozenset({torch.float32}), screen_filters=frozenset({"classic"}), covariances=False
    )

    def lacking(self, needs: Needs) -> list[str]:
        missing = [] if importlib.util.find_spec("gsplat") else ["it needs gsplat: pip install 'gsplat>=1.5'"]
        return missing + self.capabilities.lacking(needs)

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        reasons = self.lacking(Needs.of(gaussians, effects, gradients=True))
        if reasons:
            raise BackendUnavailable(f"backend {self.name!r} cannot do this: {'; '.join(reasons)}")
        flat, colors = project(gaussians, camera, effects)
        with torch.no_grad():
            pixels, splats = touching_pairs(flat, camera)
        image, alpha = accumulate(flat, colors, pixels, splats, camera)
        return Rendered(image + (1 - alpha)[..., None] * image.new_tensor(effects.background), alpha)


def project(gaussians: Gaussians, camera: Camera, effects: Effects) -> tuple[Flat, Tensor]:
    """gsplat's own part: splats on the image plane and their colors [N, 3]."""
    twins = importlib.import_module("gsplat.cuda._torch_impl")
    means, sh = gaussians.means, gaussians.sh
    intrinsics = means.new_tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    covariances, _ = twins._quat_scale_to_covar_preci(gaussians.quats, gaussians.scales, compute_preci=False)
    projected = twins._fully_fused_projection(
        means, covariances, camera.viewmat.to(means)[None], intrinsics[None], camera.width, camera.height, effects.eps2d, effects.near_plane
    )
    radii, means2d, depths, conics = (part[0] for part in projected[:4])
    degree = min(effects.sh_degree, gaussians.sh_degree)
    colors = twins._spherical_harmonics(degree, means - camera.center.to(means), sh).add(0.5).clamp_min(0)
    return Flat(radii, means2d, depths, conics, gaussians.opacities), colors


def touching_pairs(flat: Flat, camera: Camera) -> tuple[Tensor, Tensor]:
    """The pixels [M] and splats [M] where alpha reaches 1/255: pixel by pixel, front to back."""
    columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
    reach = (flat.opacities / MIN_ALPHA).log()
    pixels, splats = [], []
    for tile, ids in enumerate(tile_lists(flat, columns, rows)):
        x, y = torch.meshgrid(tile % columns * TILE + torch.arange(TILE), tile // columns * TILE + torch.arange(TILE), indexing="xy")
        inside = (y * camera.width + x)[(x < camera.width) & (y < camera.height)]
        which, nth = (sigmas(flat, ids[None], inside[:, None], camera) <= reach[ids]).nonzero(as_tuple=True)
        pixels.append(inside[which])
        splats.append(ids[nth])
    return torch.cat(pixels), torch.cat(splats)


def tile_lists(flat: Flat, columns: int, rows: int) -> tuple[Tensor, ...]:
    """For each tile the splats whose box of gsplat's radii reaches it, front to back."""
    drawn = flat.depths.argsort()
    drawn = drawn[(flat.radii[drawn] > 0).all(1)]
    center, radius, grid = flat.means[drawn] / TILE, flat.radii[drawn] / TILE, flat.means.new_tensor([columns, rows])
    low, high = (center - radius).floor().clamp_min(0).minimum(grid).long(), (center + radius).ceil().clamp_min(0).minimum(grid).long()
    spans = (high - low).clamp_min(0)
    counts = spans.prod(1)
    owner = torch.arange(len(drawn)).repeat_interleave(counts)
    nth = torch.arange(len(owner)) - (counts.cumsum(0) - counts)[owner]
    tiles = (low[owner, 1] + nth // spans[owner, 0]) * columns + low[owner, 0] + nth % spans[owner, 0]
    by_tile = tiles.sort(stable=True)
    return drawn[owner[by_tile.indices]].split(torch.bincount(tiles, minlength=columns * rows).tolist())


def accumulate(flat: Flat, colors: Tensor, pixels: Tensor, splats: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Blend the pairs [M] of `touching_pairs`, each pixel's up to where it is opaque: color [H, W, 3] and alpha [H, W]."""
    alpha = (_take(flat.opacities, splats) * torch.exp(-sigmas(flat, splats, pixels, camera))).clamp_max(MAX_ALPHA)
    # The product over a pixel's nearer splats as a difference of running sums of logarithms; float64 keeps it exact over all pixels.
    logs = torch.log1p(-alpha.double())
    nearer = logs.cumsum(0) - logs
    counts = pixels.unique_consecutive(return_counts=True)[1]
    nearer = nearer - _take(nearer, (counts.cumsum(0) - counts).repeat_interleave(counts))
    is_open = (nearer + logs).detach() > math.log(MIN_TRANSMITTANCE)
    weights = torch.where(is_open, alpha * nearer.exp().to(alpha), 0.0)
    count = camera.width * camera.height
    color = colors.new_zeros(count, 3).index_add(0, pixels, weights[:, None] * colors.index_select(0, splats))
    opaque = colors.new_zeros(count).index_add(0, pixels, weights)
    return color.view(*camera.size, 3), opaque.view(camera.size)


def sigmas(flat: Flat, splats: Tensor, pixels: Tensor, camera: Camera) -> Tensor:
    """Half the squared Mahalanobis distance of splats and pixels, indices of any shapes that broadcast."""
    dx = pixels % camera.width + 0.5 - _take(flat.means[:, 0], splats)
    dy = pixels // camera.width + 0.5 - _take(flat.means[:, 1], splats)
    xx, xy, yy = (_take(entry, splats) for entry in flat.conics.unbind(1))
    return 0.5 * (xx * dx.square() + yy * dy.square()) + xy * dx * dy


def _take(values: Tensor, ids: Tensor) -> Tensor:
    """values[ids] by index_select, whose backward pass is much faster on a CPU."""
    return values.index_select(0, ids.flatten()).view(ids.shape)
