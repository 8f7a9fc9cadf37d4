"""Density control: splats are dropped where they do nothing, and cloned or split where the image asks for more (Kerbl et al. 2023, 5.2)."""

from __future__ import annotations

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimizer import change_rows
from mipmap_plugin.backends.projection import rotations
from mipmap_plugin.camera import Camera
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import SplatModel

# The published constants: a splat larger than this share of the scene's extent is split, a smaller one cloned;
# the two halves of a split are this much smaller than the whole.
SPLIT_EXTENT = 0.01
SPLIT_SHRINK = 1.6

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
        viewmat = camera.viewmat.to(means)
        depths = (means.detach() @ viewmat[2, :3] + viewmat[2, 3]).abs()
        across = gradient @ viewmat[:2, :3].T
        per_ndc = across * depths[:, None] * across.new_tensor([camera.width / camera.fx, camera.height / camera.fy]) / 2
        norm = per_ndc.norm(dim=1)
        self.total += norm
        self.seen += (norm > 0).to(norm)

    def mean(self) -> Tensor:
        return self.total / self.seen.clamp_min(1)


def prune(model: SplatModel, optimizer: torch.optim.Adam, keep: Tensor) -> None:
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


def densify(model: SplatModel, optimizer: torch.optim.Adam, grown: Tensor, extent: float, shown: Gaussians, generator: torch.Generator) -> None:
    """Clone the small and split the large among the rows where `grown` [N] is True. `shown`: the model's activated splats.

    Works on families whose parameters are a plain splat's (means, log scales and the rest by row); anchors, which never move,
    have no gradient to grow by.
    """
    if not grown.any():
        return
    large = shown.scales.max(dim=1).values > SPLIT_EXTENT * extent
    split, clone = grown & large, grown & ~large
    rows = torch.cat([(~split).nonzero()[:, 0], clone.nonzero()[:, 0], split.nonzero()[:, 0].repeat(2)])
    first_half = len(rows) - 2 * int(split.sum())
    halves = rows[first_half:]
    noise = torch.randn(len(halves), 3, generator=generator).to(shown.means)
    moved = (rotations(shown.quats[halves]) @ (shown.scales[halves] * noise)[..., None])[..., 0]

    def rebuild(name: str, old: Tensor) -> Tensor:
        new = old[rows]
        if name == "means":
            new[first_half:] += moved
        if name == "scales":
            new[first_half:] -= torch.tensor(SPLIT_SHRINK).log()
        return new

    fresh = torch.arange(len(rows), device=rows.device) >= int((~split).sum())
    change_rows(model, optimizer, rebuild, lambda old: old[rows].masked_fill(fresh.view(-1, *[1] * (old.dim() - 1)), 0.0))


def reset_opacities(optimizer: torch.optim.Adam) -> None:
    """Cut every opacity logit to at most that of 0.01, and forget its moments."""
    for group in optimizer.param_groups:
        if group["name"] == "opacities":
            logits = group["params"][0]
            with torch.no_grad():
                logits.clamp_(max=torch.logit(torch.tensor(RESET_OPACITY)).item())
            optimizer.state[logits] = {}
