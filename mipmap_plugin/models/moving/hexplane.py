"""4D Gaussians (Wu et al. 2024): canonical splats, and feature planes over space and time from which changes of parameters are decoded."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations, count, takewhile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, relu

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.state_dict import require, run_layer, shapes_of
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.detect import detect
from mipmap_plugin.models.inria_folder import read_options
from mipmap_plugin.models.moving.memory import Changes
from mipmap_plugin.models.moving.model import MovingModel, read_canonical
from mipmap_plugin.models.places import is_coarse
from mipmap_plugin.models.reading import read_splats
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.splatting.rotations import quaternion_product

NET = "deformation_net."  # prefix of the names of all weights in use

# The heads by name: number of outputs, the option that disables it, and the option's default (arguments/__init__.py).
HEADS = {
    "pos_deform": (3, "no_dx", False),
    "scales_deform": (3, "no_ds", False),
    "rotations_deform": (4, "no_dr", False),
    "opacity_deform": (1, "no_do", True),
    "shs_deform": (48, "no_dshs", True),
}

# The parameters that the heads change.
POSITIONS = "pos_deform"
CHANGED = dict(zip(HEADS, ("means", "scales", "quats", "opacities", "sh"), strict=True))

# The two coordinates of each plane of a scale: xy, xz, xt, yz, yt, zt.
PLANES = list(combinations(range(4), 2))

# Splats drawn and differentiated in the time of one look-up with its slopes and its part of the network: 12 take 21 µs, and a splat 0.7.
DRAWS_A_LOOK_UP = 2.5

# Options that the published code describes as useless; no published model was trained with them.
UNREAD = ("empty_voxel", "grid_pe")


class HexPlane:
    """Features of a position and a time, looked up in planes at several scales, and small networks that decode them."""

    def __init__(self, weights: Mapping[str, Tensor], options: Mapping[str, Any], where: str = "the network") -> None:
        """`weights`: the tensors of a `deformation.pth` by name; `options`: cfg_args. Raises CheckpointError, beginning with `where`."""
        for name in UNREAD:
            if options.get(name):
                raise CheckpointError(f"{where}: it was trained with {name}, which is not read by this version")
        self._weights = {name.removeprefix(NET): tensor.detach().float() for name, tensor in weights.items() if name.startswith(NET)}
        self._options = dict(options)
        self.heads = {name: size for name, (size, off, default) in HEADS.items() if not options.get(off, default)}
        self.changes_opacities = "opacity_deform" in self.heads or bool(options.get("static_mlp"))
        self.scales = len(list(takewhile(lambda scale: f"grid.grids.{scale}.0" in self._weights, count())))
        self.depth = len(list(takewhile(lambda layer: f"feature_out.{2 * layer}.weight" in self._weights, count())))
        self._check(where)
        self.is_still = self._is_still()
        self.cost, self.work = self._cost(), DRAWS_A_LOOK_UP * len(PLANES) * self.scales

    def moved(self, canonical: VanillaModel, changes: Changes) -> Gaussians:
        """The splats after `changes`, which apply to the raw parameters, before activation."""
        raw = canonical.parameters()
        mask = changes.get("mask", raw["means"].new_ones(()))
        moved = dict(raw)
        moved |= {name: raw[name] * mask + changes[name] for name in ("means", "scales") if name in changes}
        if (turn := changes.get("quats")) is not None:
            moved["quats"] = quaternion_product(raw["quats"], turn) if self._options.get("apply_rotation") else raw["quats"] + turn
        if (fade := changes.get("opacities")) is not None:
            moved["opacities"] = raw["opacities"] * mask.reshape(-1) + fade[:, 0]
        if (tint := changes.get("sh")) is not None:
            sh = torch.cat([raw["sh0"], raw["shN"]], dim=1) * mask[..., None] + tint.unflatten(1, (-1, 3))
            moved |= {"sh0": sh[:, :1], "shN": sh[:, 1:]}
        return VanillaModel(moved).gaussians()

    @torch.no_grad()
    def changes(self, means: Tensor, time: float) -> Changes:
        """What each head adds, [N, size], by the name of the parameter, and the "mask" [N, 1] that these are multiplied by, if there is one."""
        hidden = self.features(means, time)
        masks = {"mask": self._head("static_mlp", hidden)} if self._options.get("static_mlp") else {}
        return {CHANGED[name]: self._head(name, hidden) for name in self.heads} | masks

    @property
    def slopes(self) -> Callable[[Tensor, float], Changes] | None:
        """As the original's gradient of a mean goes through the field; None if it moves none."""
        return self._slopes if POSITIONS in self.heads else None

    def _slopes(self, means: Tensor, time: float) -> Changes:
        """The derivatives of what is added to the "means" in these, [N, 3, 3]."""
        with torch.enable_grad():
            places = means.detach().requires_grad_()
            hidden = self.features(places, time)
            masked = means * self._head("static_mlp", hidden) if self._options.get("static_mlp") else 0
            added = masked + self._head(POSITIONS, hidden)
            rows = [torch.autograd.grad(added[:, axis].sum(), places, retain_graph=axis < 2)[0] for axis in range(3)]
        return {"means": torch.stack(rows, dim=1)}

    def features(self, means: Tensor, time: float) -> Tensor:
        """The inputs of the heads, [N, width], at positions [N, 3] and one time."""
        moment = torch.full_like(means[:, :1], time)
        if self._options.get("no_grid"):
            hidden = torch.cat([means, moment], dim=1)
        else:
            high, low = self._weights["grid.aabb"]  # in this order
            place = torch.cat([(means - high) * (2 / (low - high)) - 1, moment], dim=1)
            hidden = torch.cat([self._look_up(scale, place) for scale in range(self.scales)], dim=1)
        for layer in range(self.depth):
            hidden = run_layer(self._weights, f"feature_out.{2 * layer}", relu(hidden) if layer else hidden)
        return hidden

    def to(self, device: torch.device | str) -> HexPlane:
        """The same field on another device."""
        return HexPlane({NET + name: tensor.to(device) for name, tensor in self._weights.items()}, self._options)

    def _look_up(self, scale: int, place: Tensor) -> Tensor:
        """The product over the planes of one scale, [N, channels]. Positions outside the box are clamped to it."""
        product = torch.ones_like(place[:, :1])
        for number, axes in enumerate(PLANES):
            plane = self._weights[f"grid.grids.{scale}.{number}"]
            sampled = grid_sample(plane, place[None, None, :, axes], mode="bilinear", padding_mode="border", align_corners=True)
            product = product * sampled[0, :, 0].T
        return product

    def _head(self, name: str, hidden: Tensor) -> Tensor:
        return run_layer(self._weights, f"{name}.3", relu(run_layer(self._weights, f"{name}.1", relu(hidden))))

    def _is_still(self) -> bool:
        """Whether the field changes nothing: all heads add 0, and none multiplies by an output of the network."""
        multiplies = self.heads and (self._options.get("static_mlp") or ("rotations_deform" in self.heads and self._options.get("apply_rotation")))
        return not multiplies and not any(self._weights[f"{head}.3.{part}"].any() for head in self.heads for part in ("weight", "bias"))

    def _cost(self) -> str:
        parts = ("feature_out", *self.heads)
        products = sum(tensor.numel() for name, tensor in self._weights.items() if name.split(".")[0] in parts and name.endswith("weight"))
        return f"{len(PLANES) * self.scales} look-ups and {products:,} multiplications a splat and moment"

    def _check(self, where: str) -> None:
        grids = {f"grid.grids.{scale}.0": (1, -1, -1, -1) for scale in range(max(1, self.scales))}
        require(self._weights, {"grid.aabb": (2, 3), "feature_out.0.weight": (-1, -1), **grids}, where)
        width = len(self._weights["feature_out.0.weight"])
        channels = {scale: self._weights[f"grid.grids.{scale}.0"].shape[1] for scale in range(self.scales)}
        layers = {f"feature_out.{2 * layer}": (width, width) for layer in range(1, self.depth)}
        layers["feature_out.0"] = (width, 4 if self._options.get("no_grid") else sum(channels.values()))
        for name, size in {**self.heads, **({"static_mlp": 1} if self._options.get("static_mlp") else {})}.items():
            layers |= {f"{name}.1": (width, width), f"{name}.3": (size, width)}
        planes = {f"grid.grids.{scale}.{number}": (1, count, -1, -1) for scale, count in channels.items() for number in range(len(PLANES))}
        require(self._weights, shapes_of(layers) | planes, where)


def load_hexplane(path: str | Path, *, iteration: int | None = None) -> MovingModel | VanillaModel:
    """Load a model folder of 4D Gaussians; a PLY of its coarse stage, in which nothing moves, is plain 3DGS. Raises CheckpointError."""
    checkpoint = detect(path, iteration=iteration)
    if checkpoint.family == "4dgs" and is_coarse(checkpoint.path):
        model = read_splats(checkpoint, VanillaModel)
        model.notes.append("it is of the coarse stage of 4D Gaussians, in which nothing moves yet")
        return model
    canonical, network, weights = read_canonical(path, iteration, "4dgs")
    options, _ = read_options(canonical.folder)
    if not options:
        canonical.notes.append("no cfg_args tells which of the network's changes are in use: opacities and colors are taken to stay, as published")
    field = HexPlane(weights, options, f"{network} is not a network as the project publishes it")
    if "shs_deform" in field.heads and canonical.sh_degree != 3:
        mismatch = f"{network} changes colors of SH degree 3, but its PLY has {canonical.sh_degree}"
        raise CheckpointError(f"{mismatch}; give the two that were saved together")
    return MovingModel("4dgs", canonical, field)
