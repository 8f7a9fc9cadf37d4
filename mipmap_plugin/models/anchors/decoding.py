"""Decoding of anchors to splats for one camera, by the networks of Scaffold-GS (Lu et al. 2024) and Octree-GS, in pure torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SettingsError, plural
from mipmap_plugin.formats.state_dict import run_layer
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.anchors.networks import EMBEDDING, Weights
from mipmap_plugin.splatting.harmonics import C0
from mipmap_plugin.splatting.rotations import unit_quaternions


@dataclass(frozen=True, eq=False)
class Anchors:
    """Raw parameters of n anchors with k splats each."""

    means: Tensor  # [n, 3] world units
    offsets: Tensor  # [n, k, 3] in units of the anchor's first three scales
    features: Tensor  # [n, F]
    scales: Tensor  # [n, 6] log: of the offsets, then of the splats
    levels: Tensor | None = None  # [n, 1]
    fading: Tensor | float = 1.0  # [n, 1]: factor of the opacities of levels that fade in


def decode(anchors: Anchors, weights: Weights, inputs: Mapping[str, tuple[str, ...]], camera: Camera) -> tuple[Gaussians, Tensor]:
    """The M splats of positive opacity for `camera`, and the anchor index [M] of each.

    `inputs` names the inputs of each network, in order. Anchor positions have no gradient: the original's learning rate for them is 0.
    """
    means = anchors.means.detach()
    ray = means - camera.center.to(means)
    distance = ray.norm(dim=1, keepdim=True)  # an anchor at the eye has no direction, but NaN, and no opacity above 0
    values = {"features": anchors.features, "direction": ray / distance, "distance": distance}
    if anchors.levels is not None:
        values["level"] = anchors.levels
    if "appearance" in weights:
        values["appearance"] = _appearance(weights["appearance"][EMBEDDING], camera).expand(len(means), -1)

    def run(name: str) -> Tensor:
        hidden = run_layer(weights[name], "0", torch.cat([values[key] for key in inputs[name]], dim=1)).relu()
        return run_layer(weights[name], "2", hidden)

    if "feature_bank_mlp" in weights:
        values["features"] = _from_bank(anchors.features, run("feature_bank_mlp").softmax(dim=1))
    opacities = run("opacity_mlp").tanh() * anchors.fading
    row, nth = (opacities > 0).nonzero(as_tuple=True)
    shapes = run("cov_mlp").unflatten(1, (-1, 7))[row, nth]
    colors = run("color_mlp").sigmoid().unflatten(1, (-1, 3))[row, nth]
    reach, size = anchors.scales.exp().split(3, dim=1)
    centers = means[row] + anchors.offsets[row, nth] * reach[row]
    scales, quats = size[row] * shapes[:, :3].sigmoid(), unit_quaternions(shapes[:, 3:])
    return Gaussians(centers, quats, scales, opacities[row, nth], (colors[:, None] - 0.5) / C0), row


def _from_bank(features: Tensor, shares: Tensor) -> Tensor:
    """Features at three resolutions, blended with the weights `shares` [n, 3]; the coarser ones repeat every fourth or second number."""
    coarse, middle = features[:, ::4].repeat(1, 4), features[:, ::2].repeat(1, 2)
    return coarse * shares[:, :1] + middle * shares[:, 1:2] + features * shares[:, 2:]


def _appearance(table: Tensor, camera: Camera) -> Tensor:
    """The appearance [1, A] of the camera's training view, or the mean of all for a camera that is not a training view."""
    if camera.index is None:
        return table.mean(dim=0, keepdim=True)
    if not 0 <= camera.index < len(table):
        has = f"camera {camera.name!r} has index {camera.index}, but the model has the appearance of {plural(len(table), 'view')} only"
        raise SettingsError(f"{has}; give the cameras of its training, or an index of None for the mean of all")
    return table[camera.index][None]
