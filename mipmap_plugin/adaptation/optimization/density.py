"""Density control: splats are dropped where they do nothing, and cloned or split where the image asks for more (Kerbl et al. 2023, 5.2)."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.adam import Adam
from mipmap_plugin.adaptation.optimization.optimizer import change_rows
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.splatting.rotations import rotations

# The published constants: a splat larger than this share of the scene's extent is split, a smaller one cloned;
# the two halves of a split are this much smaller than the whole.
SPLIT_EXTENT = 0.01
SPLIT_SHRINK = 1.6

# Of a splat's halves: how far they lie on either side of it along its longest axis, in standard deviations. The further, the sooner
# they part, but the more the image changes: splitting all of flowers' splats leaves 39 dB at 0, 34 at 0.3, 31 at 0.5, 20 at 0.75.
HALF_APART = 0.3

# What an opacity reset leaves at most.
RESET_OPACITY = 0.01


class ScreenGradients:
    """The mean norm of each splat's screen-space gradient, in INRIA's NDC units, over the steps that saw it.

    Taken from the gradient of the world-space means, so that it needs nothing from a backend: moving a splat at depth z by one
    world unit across the view moves its image by f/z px.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self.total = torch.zeros(count, device=device)
        self.seen = torch.zeros(count, device=device)

    @classmethod
    def of(cls, means: Tensor, config: AdaptConfig) -> ScreenGradients | None:
        """An empty record of the `means` [N, 3], where anything is densified at all."""
        return None if config.densify_gradient is None else cls(len(means), means.device)

    def add(self, means: Tensor, gradient: Tensor, camera: Camera) -> None:
        """Take one view's `gradient` [N, 3] of the `means` [N, 3]."""
        depths = camera.to_camera(means.detach())[:, 2].abs()
        across = gradient @ camera.viewmat[:2, :3].to(means).T
        per_ndc = across * depths[:, None] * across.new_tensor([camera.width / camera.fx, camera.height / camera.fy]) / 2
        norm = per_ndc.norm(dim=1)
        self.total += norm
        self.seen += (norm > 0).to(norm)

    def mean(self) -> Tensor:
        return self.total / self.seen.clamp_min(1)


def prune(model: SplatModel, optimizer: Adam, keep: Tensor) -> None:
    """Drop the rows where `keep` [N] is False; the last splat stays, for an empty model has no gradient to come back by."""
    if keep.all():
        return
    if not keep.any():
        keep = keep.clone()
        keep[0] = True
    change_rows(model, optimizer, lambda _, old: old[keep], lambda old: old[keep])


def strongest(gradients: Tensor, least: float, most: int) -> Tensor:
    """[N] bool: rows of `gradients` [N] of at least `least`; where they are more than `most`, the largest of them."""
    grown = gradients >= least
    if int(grown.sum()) <= most:
        return grown
    return torch.zeros_like(grown).index_fill(0, gradients.topk(max(0, most)).indices, True)


def clone_and_split(
    model: SplatModel, optimizer: Adam, grown: Tensor, extent: float, shown: Gaussians, generator: torch.Generator
) -> None:
    """Clone the small and split the large among the rows where `grown` [N] is True. `shown`: the model's activated splats.

    Works on families whose parameters are a plain splat's (means, log scales and the rest by row); anchors, which never move,
    have no gradient to grow by, and so never get here.
    """
    large = shown.scales.max(dim=1).values > SPLIT_EXTENT * extent
    split, clone = (grown & large).nonzero()[:, 0], (grown & ~large).nonzero()[:, 0]
    noise = torch.randn(2 * len(split), 3, generator=generator).to(shown.means)
    offsets = torch.cat([shown.means.new_zeros(len(clone), 3), shown.scales[split.repeat(2)] * noise])

    def shape(name: str, new: Tensor) -> None:
        if name == "scales":
            new[len(clone) :] -= math.log(SPLIT_SHRINK)

    parents = torch.cat([clone, split.repeat(2)])
    _grow(model, optimizer, ~(grown & large), parents, _in_world(offsets, shown.quats[parents]), shape)


def halve(model: SplatModel, optimizer: Adam, grown: Tensor, shown: Gaussians) -> None:
    """Split the rows where `grown` [N] is True in two along their longest axis, so that they show almost what they did.

    In one place, two of opacity b and size s have the light of one of opacity a and size 1 where s² (2b - b²/2) = a. Of all such
    pairs that with b = a/2 + a²/5 is closest to it (least squares, within 5 % for any a); 3DGS-MCMC (Kheradmand et al. 2024, eq. 9)
    keeps the center's brightness instead, and is up to 12 % away. Moved apart, the longest axis is shorter by what that adds to the
    variance, and the opacity higher by as much. Works on the families that `clone_and_split` works on; shapes behind a 3D filter
    shrink by less.
    """
    rows = grown.nonzero()[:, 0].repeat(2)
    opacity = shown.opacities[rows]
    share = 1 / 2 + opacity / 5
    size = (share * (2 - opacity * share / 2)).rsqrt()
    shorter = math.sqrt(1 - HALF_APART**2)
    longest = torch.nn.functional.one_hot(shown.scales[rows].argmax(dim=1), 3)
    side = torch.ones_like(share).index_fill(0, torch.arange(len(rows) // 2, device=rows.device), -1.0)
    offsets = shown.scales[rows] * longest * (HALF_APART * side)[:, None]

    def shape(name: str, new: Tensor) -> None:
        if name == "scales":
            new += size.log()[:, None] + longest * math.log(shorter)
        if name == "opacities":
            new.copy_((new.sigmoid() * share / shorter).logit())

    _grow(model, optimizer, ~grown, rows, _in_world(offsets, shown.quats[rows]), shape)


def _in_world(offsets: Tensor, quats: Tensor) -> Tensor:
    """Offsets [M, 3] along the axes of splats turned by `quats` [M, 4], along those of the world."""
    return (rotations(quats) @ offsets[..., None])[..., 0]


def _grow(
    model: SplatModel, optimizer: Adam, kept: Tensor, parents: Tensor, offsets: Tensor, shape: Callable[[str, Tensor], None]
) -> None:
    """Leave the rows that are `kept` [N], and add a child of each of the `parents` [M], `offsets` [M, 3] away.

    `shape` changes the children's other parameters, in place.
    """
    rows = torch.cat([kept.nonzero()[:, 0], parents])
    old_rows = len(rows) - len(parents)

    def rebuild(name: str, old: Tensor) -> Tensor:
        new = old[rows]
        if name == "means":
            new[old_rows:] += offsets
        else:
            shape(name, new[old_rows:])
        return new

    fresh = torch.arange(len(rows), device=rows.device) >= old_rows
    change_rows(model, optimizer, rebuild, lambda old: old[rows].masked_fill(fresh.view(-1, *[1] * (old.dim() - 1)), 0.0))


def reset_opacities(optimizer: Adam) -> None:
    """Cut every opacity logit to at most that of 0.01, and forget its moments."""
    for group in optimizer.param_groups:
        if group["name"] == "opacities":
            logits = group["params"][0]
            with torch.no_grad():
                logits.clamp_(max=torch.logit(torch.tensor(RESET_OPACITY)).item())
            optimizer.state[logits] = {}
