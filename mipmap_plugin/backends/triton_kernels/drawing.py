"""The forward and backward pass: which kernels run, on which arrays, and in which order."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
from torch import Tensor

from mipmap_plugin.backends.triton_kernels import BACKWARD_BATCH, FORWARD_BATCH, MANY_TILES, RECORD, SPLATS, TILE, WARPS_OF_FEW, WARPS_OF_MANY
from mipmap_plugin.backends.triton_kernels.binning import Bins, bin_splats
from mipmap_plugin.backends.triton_kernels.compositing import composite_kernel
from mipmap_plugin.backends.triton_kernels.compositing_back import composite_back_kernel, gather_kernel
from mipmap_plugin.backends.triton_kernels.projection import project_kernel
from mipmap_plugin.backends.triton_kernels.projection_back import project_back_kernel
from mipmap_plugin.backends.triton_kernels.views import view_parameters
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.splatting.filters import compensates

# Rows of one splat that are summed at a time: one per lane of a warp.
ROWS = 32


@dataclass(frozen=True)
class KernelSplats:
    """N splats as the kernels read them; each tensor is contiguous."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    covariances: Tensor | None

    @classmethod
    def of(cls, *tensors: Tensor | None) -> KernelSplats:
        """Splats of tensors in the order of the fields above."""
        return cls(*(tensor if tensor is None else tensor.contiguous() for tensor in tensors))  # type: ignore[arg-type]  # only the last is None

    @property
    def shapes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Quaternions, scales and covariances. Without covariances the last is a placeholder, which no kernel reads."""
        return self.quats, self.scales, self.quats if self.covariances is None else self.covariances


@dataclass(frozen=True, eq=False)
class Drawing:
    """What the backward pass needs of the forward pass, besides the splats."""

    camera: Camera
    constants: dict[str, int | bool]  # that the projection kernels are compiled for
    view: Tensor
    records: Tensor  # [N, 9]
    depths: Tensor  # [N], infinite where a splat is not drawn
    bins: Bins


def tile_grid(camera: Camera) -> tuple[int, int]:
    """The number of tiles along x and y."""
    return triton.cdiv(camera.width, TILE), triton.cdiv(camera.height, TILE)


def warps_for(tiles: int) -> int:
    """Warps per tile."""
    return WARPS_OF_MANY if tiles >= MANY_TILES else WARPS_OF_FEW


def draw(splats: KernelSplats, camera: Camera, effects: Effects) -> tuple[Tensor, Tensor, Drawing]:
    """Image [H, W, 3] with its background, transmittance [H, W], and what `draw_back` needs."""
    means, count = splats.means, len(splats.means)
    tiles_x, tiles_y = tile_grid(camera)
    view = view_parameters(camera, effects, means)
    constants = {
        "HAS_COVARIANCES": splats.covariances is not None,
        "COMPENSATES": compensates(effects.screen_filter),
        "DEGREE": min(effects.sh_degree, round(splats.sh.shape[1] ** 0.5) - 1),
        "BANDS": splats.sh.shape[1],
    }
    records, depths = means.new_empty(count, RECORD), means.new_empty(count)
    boxes = torch.empty(count, 4, dtype=torch.int32, device=means.device)
    if count:
        project_kernel[(triton.cdiv(count, SPLATS),)](
            means, *splats.shapes, splats.opacities, splats.sh, view, records, depths, boxes, count, camera.width, camera.height, tiles_x, tiles_y,
            **constants, TILE=TILE, BLOCK=SPLATS,
        )  # fmt: skip
    bins = bin_splats(records, depths, boxes, view, tiles_x, tiles_y)
    image, transmittances = means.new_empty(*camera.size, 3), means.new_empty(*camera.size)
    composite_kernel[(tiles_x * tiles_y,)](
        records, bins.splat_ids, bins.tile_offsets, view, image, transmittances, tiles_x, camera.width, camera.height,
        TILE=TILE, BATCH=FORWARD_BATCH, num_warps=warps_for(tiles_x * tiles_y),
    )  # fmt: skip
    return image, transmittances, Drawing(camera, constants, view, records, depths, bins)


def draw_back(
    drawing: Drawing, splats: KernelSplats, image: Tensor, transmittances: Tensor, d_image: Tensor, d_alpha: Tensor, *, deterministic: bool
) -> tuple[Tensor | None, ...]:
    """Gradients of means, quats, scales, opacities, sh and covariances from those of image and alpha. None for the shape that is not in use."""
    d_records = _record_gradients(drawing, image, transmittances, d_image.contiguous(), d_alpha.contiguous(), deterministic)
    covariances = splats.covariances
    d_means, d_opacities, d_sh = (torch.empty_like(tensor) for tensor in (splats.means, splats.opacities, splats.sh))
    d_quats, d_scales = (None, None) if covariances is not None else (torch.empty_like(splats.quats), torch.empty_like(splats.scales))
    d_covariances = None if covariances is None else torch.empty_like(covariances)
    if len(splats.means):
        out = [d_means if gradient is None else gradient for gradient in (d_quats, d_scales, d_covariances)]
        project_back_kernel[(triton.cdiv(len(splats.means), SPLATS),)](
            splats.means, *splats.shapes, splats.opacities, splats.sh, drawing.view, drawing.depths, d_records,
            d_means, *out, d_opacities, d_sh, len(splats.means), **drawing.constants, BLOCK=SPLATS,
        )  # fmt: skip
    return d_means, d_quats, d_scales, d_opacities, d_sh, d_covariances


def _record_gradients(drawing: Drawing, image: Tensor, transmittances: Tensor, d_image: Tensor, d_alpha: Tensor, deterministic: bool) -> Tensor:
    """Gradients of the records, [N, 9]."""
    camera, bins = drawing.camera, drawing.bins
    tiles_x, tiles_y = tile_grid(camera)
    d_records = torch.zeros_like(drawing.records)
    target = d_records.new_zeros(len(bins.splat_ids), RECORD) if deterministic else d_records
    composite_back_kernel[(tiles_x * tiles_y,)](
        drawing.records, bins.splat_ids, bins.tile_offsets, bins.places, drawing.view, image, transmittances, d_image, d_alpha, target,
        tiles_x, camera.width, camera.height, TILE=TILE, BATCH=BACKWARD_BATCH, DETERMINISTIC=deterministic, num_warps=warps_for(tiles_x * tiles_y),
    )  # fmt: skip
    if deterministic and len(d_records):
        gather_kernel[(len(d_records),)](target, bins.starts, bins.counts, d_records, ROWS=ROWS, num_warps=1)
    return d_records
