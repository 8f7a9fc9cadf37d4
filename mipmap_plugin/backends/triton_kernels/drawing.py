"""From splats to an image and back: which kernels run, on what, and in which order."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
from torch import Tensor

from mipmap_plugin.backends.triton_kernels import BACKWARD_BATCH, FORWARD_BATCH, MANY_TILES, RECORD, SPLATS, TILE, WARPS_OF_FEW, WARPS_OF_MANY
from mipmap_plugin.backends.triton_kernels.binning import Bins, bins
from mipmap_plugin.backends.triton_kernels.compositing import composite_kernel
from mipmap_plugin.backends.triton_kernels.compositing_back import composite_back_kernel, gather_kernel
from mipmap_plugin.backends.triton_kernels.projection import project_kernel
from mipmap_plugin.backends.triton_kernels.projection_back import project_back_kernel
from mipmap_plugin.backends.triton_kernels.views import row_of
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.splatting.filters import keeps_light

# Rows of one splat that are added up at a time, a warp's worth.
ROWS = 32


@dataclass(frozen=True)
class Splats:
    """N splats as the kernels take them; each tensor is contiguous."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    covariances: Tensor | None

    @classmethod
    def of(cls, *tensors: Tensor | None) -> Splats:
        return cls(*(tensor if tensor is None else tensor.contiguous() for tensor in tensors))  # type: ignore[arg-type]

    @property
    def shapes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Quaternions, scales and covariances; a kernel never reads the one that is not given, but has to get something."""
        return self.quats, self.scales, self.quats if self.covariances is None else self.covariances


@dataclass(frozen=True, eq=False)
class Drawing:
    """What the way back needs of the way there, besides the splats."""

    camera: Camera
    kind: dict[str, int | bool]  # what the projection is compiled for
    view: Tensor
    records: Tensor  # [N, 9]
    depths: Tensor  # [N], infinite where a splat is not drawn
    bins: Bins


def grid_of(camera: Camera) -> tuple[int, int]:
    """Columns and rows of tiles."""
    return triton.cdiv(camera.width, TILE), triton.cdiv(camera.height, TILE)


def warps_of(tiles: int) -> int:
    return WARPS_OF_MANY if tiles >= MANY_TILES else WARPS_OF_FEW


def draw(splats: Splats, camera: Camera, effects: Effects) -> tuple[Tensor, Tensor, Drawing]:
    """Image [H, W, 3] with its background, transmittance [H, W], and what `draw_back` needs."""
    means, count = splats.means, len(splats.means)
    columns, rows = grid_of(camera)
    view = row_of(camera, effects, means)
    kind = {
        "GIVEN": splats.covariances is not None,
        "COMPENSATES": keeps_light(effects.screen_filter),
        "DEGREE": min(effects.sh_degree, round(splats.sh.shape[1] ** 0.5) - 1),
        "BANDS": splats.sh.shape[1],
    }
    records, depths = means.new_empty(count, RECORD), means.new_empty(count)
    boxes = torch.empty(count, 4, dtype=torch.int32, device=means.device)
    if count:
        project_kernel[(triton.cdiv(count, SPLATS),)](
            means, *splats.shapes, splats.opacities, splats.sh, view, records, depths, boxes, count, camera.width, camera.height, columns, rows,
            **kind, TILE=TILE, BLOCK=SPLATS,
        )  # fmt: skip
    sorted_ = bins(records, depths, boxes, view, columns, rows)
    image, through = means.new_empty(*camera.size, 3), means.new_empty(*camera.size)
    composite_kernel[(columns * rows,)](
        records, sorted_.members, sorted_.edges, view, image, through, columns, camera.width, camera.height,
        TILE=TILE, BATCH=FORWARD_BATCH, num_warps=warps_of(columns * rows),
    )  # fmt: skip
    return image, through, Drawing(camera, kind, view, records, depths, sorted_)


def draw_back(
    drawing: Drawing, splats: Splats, image: Tensor, through: Tensor, d_image: Tensor, d_alpha: Tensor, *, deterministic: bool
) -> tuple[Tensor | None, ...]:
    """Gradients of means, quats, scales, opacities, sh and covariances, from those of image and alpha; None where a shape was not given."""
    pulls = _pulls(drawing, image, through, d_image.contiguous(), d_alpha.contiguous(), deterministic)
    given = splats.covariances
    d_means, d_opacities, d_sh = (torch.empty_like(tensor) for tensor in (splats.means, splats.opacities, splats.sh))
    d_quats, d_scales = (None, None) if given is not None else (torch.empty_like(splats.quats), torch.empty_like(splats.scales))
    d_covariances = None if given is None else torch.empty_like(given)
    if len(splats.means):
        out = [d_means if gradient is None else gradient for gradient in (d_quats, d_scales, d_covariances)]
        project_back_kernel[(triton.cdiv(len(splats.means), SPLATS),)](
            splats.means, *splats.shapes, splats.opacities, splats.sh, drawing.view, drawing.depths, pulls,
            d_means, *out, d_opacities, d_sh, len(splats.means), **drawing.kind, BLOCK=SPLATS,
        )  # fmt: skip
    return d_means, d_quats, d_scales, d_opacities, d_sh, d_covariances


def _pulls(drawing: Drawing, image: Tensor, through: Tensor, d_image: Tensor, d_alpha: Tensor, deterministic: bool) -> Tensor:
    """[N, 9], the gradients of the records."""
    camera, bins_ = drawing.camera, drawing.bins
    columns, rows = grid_of(camera)
    pulls = torch.zeros_like(drawing.records)
    target = pulls.new_zeros(len(bins_.members), RECORD) if deterministic else pulls
    composite_back_kernel[(columns * rows,)](
        drawing.records, bins_.members, bins_.edges, bins_.rows, drawing.view, image, through, d_image, d_alpha, target,
        columns, camera.width, camera.height, TILE=TILE, BATCH=BACKWARD_BATCH, DETERMINISTIC=deterministic, num_warps=warps_of(columns * rows),
    )  # fmt: skip
    if deterministic and len(pulls):
        gather_kernel[(len(pulls),)](target, bins_.starts, bins_.counts, pulls, ROWS=ROWS, num_warps=1)
    return pulls
