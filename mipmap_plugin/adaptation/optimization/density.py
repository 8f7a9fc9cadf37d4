"""Density control: transparent splats are removed, and splats with large screen gradients are cloned or split (Kerbl et al. 2023, 5.2)."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.adam import Adam
from mipmap_plugin.adaptation.optimization.following import keep_rows
from mipmap_plugin.adaptation.optimization.optimizer import change_rows
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.splatting.rotations import rotations

# The published constants: a splat larger than this fraction of the scene's extent is split, a smaller one is cloned;
# the scales of the two halves are divided by SPLIT_SHRINK.
SPLIT_EXTENT = 0.01
SPLIT_SHRINK = 1.6

# Distance of a splat's halves from its center along its longest axis, in standard deviations. A larger one separates them sooner, but
# changes the image more: splitting all splats of flowers leaves 39 dB at 0, 34 at 0.3, 31 at 0.5, 20 at 0.75.
HALF_APART = 0.3

# Rows that are moved together: megabytes.
ROWS_MOVED = 1 << 14

# An opacity reset lowers every opacity to at most this.
RESET_OPACITY = 0.01


class ScreenGradients:
    """The mean norm of each splat's screen-space gradient, in INRIA's NDC units, over the views that saw it.

    It is computed from the gradient of the world-space means, so that a backend does not have to provide it: moving a splat at depth z
    by one world unit across the view moves its image by f/z px.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self.total = torch.zeros(count, device=device)
        self.seen = torch.zeros(count, device=device)

    @classmethod
    def of(cls, means: Tensor, config: AdaptConfig) -> ScreenGradients | None:
        """An empty record for the `means` [N, 3], or None if the settings densify nothing."""
        return None if config.densify_gradient is None else cls(len(means), means.device)

    def add(self, means: Tensor, gradient: Tensor, camera: Camera) -> None:
        """Add the `gradient` [N, 3] of the `means` [N, 3] in one view."""
        depths = camera.to_camera(means.detach())[:, 2].abs()
        grad_xy = gradient @ camera.viewmat[:2, :3].to(means).T
        grad_ndc = grad_xy * depths[:, None] * grad_xy.new_tensor([camera.width / camera.fx, camera.height / camera.fy]) / 2
        norm = grad_ndc.norm(dim=1)
        self.total += norm
        self.seen += (norm > 0).to(norm)

    def mean(self) -> Tensor:
        """[N]: the mean norm over the views that saw each splat; 0 for one that no view saw."""
        return self.total / self.seen.clamp_min(1)


def prune(model: SplatModel, optimizer: Adam, keep: Tensor) -> None:
    """Remove the rows where `keep` [N] is False. At least one splat stays, because an empty model has no gradient to recover by.

    What is kept moves up in the memory of the old tensors, which are of no use afterwards: a copy of a large scene has no room beside its optimizer.
    """
    if keep.all():
        return
    if not keep.any():
        keep = keep.clone()
        keep[0] = True
    rows = keep.nonzero()[:, 0]
    keep_rows(model, rows)
    change_rows(model, optimizer, lambda _, old: _moved_up(old, rows), lambda old: _moved_up(old, rows))


def _moved_up(tensor: Tensor, rows: Tensor) -> Tensor:
    """The ascending `rows` [M] of a tensor [N, ...], in its own memory: none is written to before it is read."""
    at = 0
    for part in rows.split(ROWS_MOVED):
        tensor[at : at + len(part)] = tensor[part]
        at += len(part)
    return tensor[:at]


def strongest(gradients: Tensor, threshold: float, max_count: int) -> Tensor:
    """[N] bool: where `gradients` [N] reach `threshold`; of more than `max_count` such rows only the largest."""
    selected = gradients >= threshold
    if int(selected.sum()) <= max_count:
        return selected
    return torch.zeros_like(selected).index_fill(0, gradients.topk(max(0, max_count)).indices, True)


def clone_and_split(model: SplatModel, optimizer: Adam, selected: Tensor, extent: float, splats: Gaussians, generator: torch.Generator) -> None:
    """Clone the small and split the large splats among the rows where `selected` [N] is True. `splats`: the model's activated splats.

    For families whose rows are splats (means, log scales and the rest by row). Anchors never move, so that they have no gradient to
    grow by and never get here.
    """
    large = splats.scales.max(dim=1).values > SPLIT_EXTENT * extent
    split, clone = (selected & large).nonzero()[:, 0], (selected & ~large).nonzero()[:, 0]
    noise = torch.randn(2 * len(split), 3, generator=generator).to(splats.means)
    offsets = torch.cat([splats.means.new_zeros(len(clone), 3), splats.scales[split.repeat(2)] * noise])

    def change(name: str, new: Tensor) -> None:
        if name == "scales":
            new[len(clone) :] -= math.log(SPLIT_SHRINK)

    parents = torch.cat([clone, split.repeat(2)])
    _grow(model, optimizer, ~(selected & large), parents, _in_world(offsets, splats.quats[parents]), change)


def halve(model: SplatModel, optimizer: Adam, selected: Tensor, splats: Gaussians) -> None:
    """Split the rows where `selected` [N] is True in two along their longest axis, so that the image hardly changes.

    In the same place, two splats of opacity b and size s have together the blend weight of one of opacity a and size 1 if
    s² (2b - b²/2) = a. Of all such pairs the one with b = a/2 + a²/5 is closest to it (least squares, within 5 % for any a); 3DGS-MCMC
    (Kheradmand et al. 2024, eq. 9) keeps the brightness at the center instead, and is up to 12 % off. As the halves are moved apart,
    the longest axis is shortened by what that adds to the variance, and the opacity raised by the same factor. For the same families as
    `clone_and_split`; shapes behind a 3D filter shrink by less.
    """
    rows = selected.nonzero()[:, 0].repeat(2)
    opacity = splats.opacities[rows]
    fraction = 1 / 2 + opacity / 5
    size = (fraction * (2 - opacity * fraction / 2)).rsqrt()
    shortening = math.sqrt(1 - HALF_APART**2)
    longest = torch.nn.functional.one_hot(splats.scales[rows].argmax(dim=1), 3)
    side = torch.ones_like(fraction).index_fill(0, torch.arange(len(rows) // 2, device=rows.device), -1.0)
    offsets = splats.scales[rows] * longest * (HALF_APART * side)[:, None]

    def change(name: str, new: Tensor) -> None:
        if name == "scales":
            new += size.log()[:, None] + longest * math.log(shortening)
        if name == "opacities":
            new.copy_((new.sigmoid() * fraction / shortening).logit())

    _grow(model, optimizer, ~selected, rows, _in_world(offsets, splats.quats[rows]), change)


def _in_world(offsets: Tensor, quats: Tensor) -> Tensor:
    """Offsets [M, 3] in world axes, from offsets along the axes of splats rotated by `quats` [M, 4]."""
    return (rotations(quats) @ offsets[..., None])[..., 0]


def _grow(model: SplatModel, optimizer: Adam, kept: Tensor, parents: Tensor, offsets: Tensor, change: Callable[[str, Tensor], None]) -> None:
    """Keep the rows where `kept` [N] is True, and append a child of each of the `parents` [M], displaced by `offsets` [M, 3].

    `change` modifies the children's other parameters in place.
    """
    rows = torch.cat([kept.nonzero()[:, 0], parents])
    old_rows = len(rows) - len(parents)

    def rebuild(name: str, old: Tensor) -> Tensor:
        new = old[rows]
        if name == "means":
            new[old_rows:] += offsets
        else:
            change(name, new[old_rows:])
        return new

    fresh = torch.arange(len(rows), device=rows.device) >= old_rows
    change_rows(model, optimizer, rebuild, lambda old: old[rows].masked_fill(fresh.view(-1, *[1] * (old.dim() - 1)), 0.0))


def reset_opacities(optimizer: Adam) -> None:
    """Clamp every opacity to at most `RESET_OPACITY`, and clear Adam's moments of the opacities; its steps go on (INRIA's gaussian_model.py)."""
    for group in optimizer.param_groups:
        if group["name"] == "opacities":
            logits = group["params"][0]
            with torch.no_grad():
                logits.clamp_(max=torch.logit(torch.tensor(RESET_OPACITY)).item())
            state = optimizer.state_of(logits)
            state["exp_avg"].zero_()
            state["exp_avg_sq"].zero_()
