"""From anchors to splats: the networks of Scaffold-GS (Lu et al. 2024), which Octree-GS shares, for one camera in pure torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import linear

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.anchors.networks import EMBEDDING, Weights
from mipmap_plugin.splatting.harmonics import C0
from mipmap_plugin.splatting.rotations import unit_quaternions


@dataclass(frozen=True, eq=False)
class Anchors:
    """n anchors with k splats each, raw."""

    means: Tensor  # [n, 3] world units
    offsets: Tensor  # [n, k, 3] in units of the anchor's first three scales
    features: Tensor  # [n, F]
    scales: Tensor  # [n, 6] log: of the offsets, then of the splats
    levels: Tensor | None = None  # [n, 1]
    fading: Tensor | float = 1.0  # [n, 1]: the share of their opacity that levels in transition show


def decode(anchors: Anchors, weights: Weights, inputs: Mapping[str, tuple[str, ...]], camera: Camera) -> tuple[Gaussians, Tensor]:
    """The M splats of positive opacity as `camera` meets them, and the number [M] of each one's anchor.

    `inputs` names what each network takes, in its order. Anchors themselves never move: the original's rate for them is 0.
    """
    means = anchors.means.detach()
    ray = means - camera.center.to(means)
    distance = ray.norm(dim=1, keepdim=True).clamp_min(torch.finfo(ray.dtype).tiny)
    given = {"features": anchors.features, "direction": ray / distance, "distance": distance}
    if anchors.levels is not None:
        given["level"] = anchors.levels
    if "appearance" in weights:
        given["appearance"] = _appearance(weights["appearance"][EMBEDDING], camera).expand(len(means), -1)

    def run(name: str) -> Tensor:
        return _two_layers(weights[name], torch.cat([given[each] for each in inputs[name]], dim=1))

    if "feature_bank_mlp" in weights:
        given["features"] = _from_bank(anchors.features, run("feature_bank_mlp").softmax(dim=1))
    opacities = run("opacity_mlp").tanh() * anchors.fading
    row, nth = (opacities > 0).nonzero(as_tuple=True)
    shapes = run("cov_mlp").unflatten(1, (-1, 7))[row, nth]
    colors = run("color_mlp").sigmoid().unflatten(1, (-1, 3))[row, nth]
    reach, size = anchors.scales.exp().split(3, dim=1)
    centers = means[row] + anchors.offsets[row, nth] * reach[row]
    scales, quats = size[row] * shapes[:, :3].sigmoid(), unit_quaternions(shapes[:, 3:])
    return Gaussians(centers, quats, scales, opacities[row, nth], (colors[:, None] - 0.5) / C0), row


def _two_layers(state: dict[str, Tensor], values: Tensor) -> Tensor:
    hidden = linear(values, state["0.weight"], state["0.bias"]).relu()
    return linear(hidden, state["2.weight"], state["2.bias"])


def _from_bank(features: Tensor, shares: Tensor) -> Tensor:
    """A feature at three resolutions, mixed by `shares` [n, 3]; a coarse one is every fourth or second number, repeated as a whole."""
    coarse, middle = features[:, ::4].repeat(1, 4), features[:, ::2].repeat(1, 2)
    return coarse * shares[:, :1] + middle * shares[:, 1:2] + features * shares[:, 2:]


def _appearance(table: Tensor, camera: Camera) -> Tensor:
    """[1, A]: that of the camera's training view; of a camera that has none, the mean of all."""
    if camera.index is None:
        return table.mean(dim=0, keepdim=True)
    if not 0 <= camera.index < len(table):
        raise SettingsError(f"camera {camera.name!r} has the number {camera.index}, but the model knows the appearance of {len(table)} views")
    return table[camera.index][None]
