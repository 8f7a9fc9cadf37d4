"""The forward and backward pass: which kernels run, on which arrays, and in which order. Several views are drawn by one launch of each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
import triton
from torch import Tensor

from mipmap_plugin.backends.triton_kernels import BACK_BATCH, BATCH, RECORD, SPLATS, WARPS, tile_for
from mipmap_plugin.backends.triton_kernels.binning import Splatted, emit_kernel
from mipmap_plugin.backends.triton_kernels.colors_back import color_back_kernel
from mipmap_plugin.backends.triton_kernels.compositing import composite_kernel
from mipmap_plugin.backends.triton_kernels.compositing_back import composite_back_kernel, gather_kernel
from mipmap_plugin.backends.triton_kernels.hashing import hash_in_order
from mipmap_plugin.backends.triton_kernels.lists import Lists, Part, Tiling
from mipmap_plugin.backends.triton_kernels.projection import project_kernel
from mipmap_plugin.backends.triton_kernels.projection_back import project_back_kernel
from mipmap_plugin.backends.triton_kernels.rounding import round_kernel
from mipmap_plugin.backends.triton_kernels.views import Shot, view_parameters
from mipmap_plugin.backends.triton_kernels.weighing import weigh_kernel
from mipmap_plugin.render_settings import USUAL

hash_in_order(
    project_kernel, emit_kernel, composite_kernel, round_kernel, weigh_kernel,
    composite_back_kernel, gather_kernel, color_back_kernel, project_back_kernel,
)  # fmt: skip

# Rows of one splat that are summed at a time: one per lane of a warp.
ROWS = 32

Shots = Sequence[Shot]

# Added to the bits of a rank: so they are those of a normal number.
LEAST_NORMAL = 0x00800000


class KernelSplats(NamedTuple):
    """N splats as the kernels read them; each tensor is contiguous."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    covariances: Tensor | None
    raw: bool = False  # scales are logarithms, opacities logits

    @classmethod
    def of(cls, *tensors: Tensor | None) -> KernelSplats:
        """Activated splats of tensors in the order of the fields above."""
        return cls(*(tensor if tensor is None else tensor.contiguous() for tensor in tensors))  # type: ignore[arg-type]  # only the last is None

    @property
    def arrays(self) -> tuple[Tensor, ...]:
        """The kernels' first arguments. Without covariances their place is taken by an array that no kernel reads."""
        covariances = self.quats if self.covariances is None else self.covariances
        return self.means, self.quats, self.scales, covariances, self.opacities, self.sh

    def constants(self, shots: Shots) -> dict[str, int | bool]:
        """What the projection kernels are compiled for. Where there are viewers, whose degrees of SH differ, kernels have all bands."""
        bands, viewer = self.sh.shape[1], any(shot.effects.settings != USUAL for shot in shots)
        most = round(bands**0.5) - 1
        degree = most if viewer else min(max(shot.effects.sh_degree for shot in shots), most)
        shape = {"HAS_COVARIANCES": self.covariances is not None, "RAW": self.raw, "DEGREE": degree, "BANDS": bands}
        return {**shape, "VIEWER": viewer, "BLOCK": SPLATS}

    def new_gradients(self) -> KernelSplats:
        """Arrays for the gradients; None for the shape that is not in use."""
        without = ("quats", "scales") if self.covariances is not None else ("covariances",)
        tensors = {name: getattr(self, name) for name in self._fields if name != "raw"}
        return KernelSplats(**{name: None if name in without else torch.empty_like(tensor) for name, tensor in tensors.items()})


@dataclass(frozen=True, eq=False)
class Projected:
    """N splats in V views, and the tiles that they reach."""

    shots: Shots
    constants: dict[str, int | bool]
    tile: int  # px
    most_pixels: int  # of a view
    views: Tensor  # [V, numbers of `views.py`]
    depths: Tensor  # [V · N], or other numbers in the same order; infinite where a splat is not drawn
    lists: Lists

    @property
    def viewer(self) -> bool:
        """Whether some view's settings are not the usual ones."""
        return bool(self.constants["VIEWER"])

    def parts(self) -> Iterator[tuple[Part, tuple[Tensor, Tensor]]]:
        """Each part that is drawn by one launch, and the first arguments of what composites it."""
        for part in self.lists.parts():
            yield part, (part.listed, part.bins.tile_offsets)


class Drawing(NamedTuple):
    """Views that are drawn. A view's pixels lie row by row at the beginning of its row; the rest of the row is not set."""

    projected: Projected
    images: Tensor  # [V, pixels, 3]
    transmittances: Tensor  # [V, pixels]

    def views_of(self, array: Tensor) -> list[Tensor]:
        """The part of each view [h, w, ...] of an array [V, pixels, ...]."""
        sizes = [shot.camera.size for shot in self.projected.shots]
        if len(set(sizes)) == 1:  # the views of a step: few operations, for each makes a GPU wait
            return list(array.unflatten(1, sizes[0]).unbind())
        return [row[: height * width].unflatten(0, (height, width)) for row, (height, width) in zip(array, sizes, strict=True)]

    def alpha_of(self, view: int) -> Tensor:
        """The alpha of a view, [h, w]."""
        return 1 - self.views_of(self.transmittances)[view]

    def packed(self, views: Sequence[Tensor]) -> Tensor:
        """The inverse of `views_of`, for contiguous rows; what lies after a view's pixels is not set."""
        sizes = {view.shape for view in views}
        if len(sizes) == 1:
            return torch.stack(list(views)).flatten(1, 2) if len(views) > 1 else views[0].contiguous().flatten(0, 1)[None]
        array = views[0].new_empty(len(views), self.projected.most_pixels, *views[0].shape[2:])
        for row, view in zip(array, views, strict=True):
            row[: view.shape[0] * view.shape[1]] = view.flatten(0, 1)
        return array


def project(splats: KernelSplats, shots: Shots, *, gradients: bool = True) -> Projected:
    """Project splats to all views, and list those of each tile; for gradients culled ones, too, whose sums have a fixed order if torch is told so."""
    means, rows = splats.means, len(shots) * len(splats.means)
    sizes = [shot.camera.size for shot in shots]
    pixels = [height * width for height, width in sizes]
    tile = tile_for(sum(pixels))
    tiling = Tiling(tile, [(width, height) for height, width in sizes])
    views, constants = view_parameters(shots, tile, gradients, means), splats.constants(shots)
    records, depths = means.new_empty(rows, RECORD), means.new_empty(rows)
    boxes = torch.empty(rows, 4, dtype=torch.int32, device=means.device)
    if rows:
        grid = triton.cdiv(len(means), SPLATS), len(shots)
        project_kernel[grid](*splats.arrays, views, records, depths, boxes, len(means), TILE=tile, **constants)
    for shot, keys in zip(shots, depths.view(len(shots), -1), strict=True):
        if shot.ranks is not None:
            keys.copy_(torch.where(keys < torch.inf, (shot.ranks + LEAST_NORMAL).view(keys.dtype), keys))
    fixed_order = gradients and torch.are_deterministic_algorithms_enabled()
    return Projected(shots, constants, tile, max(pixels), views, depths, Lists(Splatted(records, depths, boxes, views), tiling, fixed_order))


def draw(splats: KernelSplats, shots: Shots, *, gradients: bool = True) -> Drawing:
    """Draw all views, each over its background, before any rounding of pictures. gradients: whether `draw_back` will be called."""
    projected = project(splats, shots, gradients=gradients)
    pixels = projected.most_pixels
    images, transmittances = splats.means.new_empty(len(shots), pixels, 3), splats.means.new_empty(len(shots), pixels)
    for part, lists in projected.parts():
        composite_kernel[part.grid](
            *lists, part.views, part.of(images), part.of(transmittances), pixels,
            TILE=projected.tile, BATCH=BATCH, VIEWER=projected.viewer, num_warps=WARPS,
        )  # fmt: skip
    return Drawing(projected, images, transmittances)


def rounded(drawing: Drawing) -> Tensor:
    """The images [V, pixels, 3], of which those that views round are drawn again."""
    projected = drawing.projected
    if all(shot.effects.settings.picture_step is None for shot in projected.shots):
        return drawing.images
    images = drawing.images.clone()
    for part, lists in projected.parts():
        arrays = *lists, part.views, part.of(images)
        round_kernel[part.grid](*arrays, projected.most_pixels, TILE=projected.tile, BATCH=BATCH, num_warps=WARPS)
    return images


def draw_back(drawing: Drawing, d_images: Tensor, d_alphas: Tensor) -> Tensor:
    """Gradients of the records [V · N, 9] from those of the images [V, pixels, 3] and alphas [V, pixels]."""
    projected = drawing.projected
    d_records = projected.depths.new_zeros(len(projected.depths), RECORD)
    for part, lists in projected.parts():
        rows, owned = d_records[part.rows], part.bins.owned
        target = rows if owned is None else rows.new_zeros(len(part.listed), RECORD)
        places = part.bins.tile_offsets if owned is None else owned.places  # the first are not read
        arrays = drawing.images, drawing.transmittances, d_images, d_alphas
        composite_back_kernel[part.grid](
            *lists, part.bins.splat_ids, places, part.views, *(part.of(array) for array in arrays), target, projected.most_pixels,
            TILE=projected.tile, BATCH=BACK_BATCH[projected.tile], DETERMINISTIC=owned is not None, VIEWER=projected.viewer, num_warps=WARPS,
        )  # fmt: skip
        if owned is not None and len(rows):
            sums = torch.empty_like(rows)
            gather_kernel[(len(rows),)](target, owned.starts, owned.counts, sums, ROWS=ROWS, num_warps=1)
            rows += sums
    return d_records


def project_back(splats: KernelSplats, projected: Projected, d_records: Tensor, grads: KernelSplats, *, further: bool = False) -> None:
    """Write the gradients of the splats, summed over the views, or add them where `further`. `d_records` are those of the directions then."""
    count, constants = len(splats.means), projected.constants
    if not count:
        return
    grid, last = (triton.cdiv(count, SPLATS),), (count, len(projected.shots), int(further))
    arrays, shared = splats.arrays, {name: constants[name] for name in ("VIEWER", "BLOCK")}
    color_back_kernel[grid](
        splats.means, splats.sh, projected.views, projected.depths, d_records, grads.sh, *last,
        DEGREE=constants["DEGREE"], BANDS=constants["BANDS"], **shared,
    )  # fmt: skip
    unused = grads.means
    d_quats, d_scales, d_covariances = (unused if array is None else array for array in (grads.quats, grads.scales, grads.covariances))
    project_back_kernel[grid](
        *arrays[:-1], projected.views, projected.depths, d_records, grads.means, d_quats, d_scales, d_covariances, grads.opacities, *last,
        HAS_COVARIANCES=constants["HAS_COVARIANCES"], RAW=constants["RAW"], **shared,
    )  # fmt: skip


def weigh(splats: KernelSplats, shots: Shots) -> Tensor:
    """The sum of each splat's blend weights over each image, [V, N]."""
    projected, in_order = project(splats, shots, gradients=False), torch.are_deterministic_algorithms_enabled()
    sums = torch.zeros_like(projected.depths)
    for part, lists in projected.parts():
        rows, splat_ids = sums[part.rows], part.bins.splat_ids
        target = rows.new_zeros(len(splat_ids)) if in_order else rows
        weigh_kernel[part.grid](
            *lists, splat_ids, part.views, target, projected.most_pixels,
            TILE=projected.tile, BATCH=BATCH, DETERMINISTIC=in_order, VIEWER=projected.viewer, num_warps=WARPS,
        )  # fmt: skip
        if in_order:
            rows.index_add_(0, splat_ids.long(), target)  # by torch, in a fixed order
    return sums.view(len(shots), len(splats.means))
