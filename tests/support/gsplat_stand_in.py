"""`gsplat.rasterization` on a processor: gsplat's own torch twins, and a plain compositor in place of the part that needs CUDA."""

import inspect
from itertools import pairwise

import torch

# gsplat 1.5.3, RasterizeToPixels3DGSFwd.cu.
MAX_ALPHA = 0.999
MIN_ALPHA = 1 / 255
LAST_TRANSMITTANCE = 1e-4
TILE = 16  # px


class StandIn:
    """Takes the arguments of gsplat, keeps them in `received`, and renders them; one camera at a time."""

    def __init__(self, max_alpha: float = MAX_ALPHA) -> None:
        from gsplat.cuda import _torch_impl
        from gsplat.rendering import rasterization

        self.signature, self.twins, self.max_alpha = inspect.signature(rasterization), _torch_impl, max_alpha
        self.received: dict = {}

    def __call__(self, *args, **named):
        bound = self.signature.bind(*args, **named)
        bound.apply_defaults()
        self.received = bound.arguments
        radii, flat = self.project(**self.received)
        colors = self.colors(**self.received)
        image, transmittance = self.composite(radii, flat, colors, self.received["width"], self.received["height"])
        return (image + transmittance[..., None] * self.received["backgrounds"][0])[None], 1 - transmittance[None, ..., None], {}

    def project(self, means, quats, scales, covars, opacities, viewmats, Ks, width, height, eps2d, near_plane, far_plane, rasterize_mode, **_):
        # The CUDA kernel drops what is nearer before it divides by its depth.
        behind = (means @ viewmats[0, 2, :3] + viewmats[0, 2, 3] < near_plane)[:, None]
        means = torch.where(behind, torch.linalg.inv(viewmats[0])[:3] @ means.new_tensor([0.0, 0.0, near_plane / 2, 1.0]), means)
        if covars is None:
            covars, _ = self.twins._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        else:
            upper = torch.triu(covars)
            covars = upper + upper.mT - torch.diag_embed(torch.diagonal(covars, dim1=-2, dim2=-1))
        radii, means2d, depths, conics, compensation = self.twins._fully_fused_projection(
            means, covars, viewmats, Ks, width, height, eps2d, near_plane, far_plane, rasterize_mode == "antialiased"
        )
        compensated = opacities if compensation is None else opacities * compensation[0]
        return radii, (means2d[0], depths[0], conics[0], compensated)

    def colors(self, means, colors, sh_degree, viewmats, **_):
        directions = means - torch.inverse(viewmats)[0, :3, 3]
        return (self.twins._spherical_harmonics(sh_degree, directions, colors) + 0.5).clamp_min(0)

    def composite(self, radii, flat, colors, width, height):
        """Color [H, W, 3] and transmittance [H, W], tile by tile."""
        means2d, depths, conics, opacities = flat
        tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
        _, keys, ids = self.twins._isect_tiles(means2d[None], radii, depths[None], TILE, tiles_x, tiles_y)
        starts = [*self.twins._isect_offset_encode(keys, 1, tiles_x, tiles_y).flatten().tolist(), len(ids)]
        image = torch.zeros(tiles_y * TILE, tiles_x * TILE, 3) + 0 * (colors.sum() + opacities.sum())
        transmittance = torch.ones(tiles_y * TILE, tiles_x * TILE)
        for tile, (start, end) in enumerate(pairwise(starts)):
            y, x = tile // tiles_x * TILE, tile % tiles_x * TILE
            mine = ids[start:end].long()
            ys, xs = torch.meshgrid(y + torch.arange(TILE) + 0.5, x + torch.arange(TILE) + 0.5, indexing="ij")
            dx, dy = means2d[mine, 0, None, None] - xs, means2d[mine, 1, None, None] - ys
            a, b, c = conics[mine, :, None, None].unbind(1)
            sigma = 0.5 * (a * dx**2 + c * dy**2) + b * dx * dy
            alpha = (opacities[mine, None, None] * torch.exp(-sigma)).clamp_max(self.max_alpha)
            alpha = torch.where((sigma < 0) | (alpha < MIN_ALPHA), 0.0, alpha)
            after = torch.cumprod(1 - alpha, 0)
            open_ = after.detach() > LAST_TRANSMITTANCE
            before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
            weights = torch.where(open_, alpha * before, 0.0)
            image[y : y + TILE, x : x + TILE] += torch.einsum("kyx,kc->yxc", weights, colors[mine])
            transmittance[y : y + TILE, x : x + TILE] = torch.where(open_, 1 - alpha, 1.0).prod(0)
        return image[:height, :width], transmittance[:height, :width]
