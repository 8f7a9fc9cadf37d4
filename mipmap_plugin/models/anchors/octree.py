"""Octree-GS (Ren et al. 2024): anchors in levels of detail, which are chosen by the camera's distance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effect
from mipmap_plugin.errors import CheckpointError, SettingsError, plural
from mipmap_plugin.models.anchors.companions import NEEDED
from mipmap_plugin.models.anchors.decoding import Anchors
from mipmap_plugin.models.anchors.files import AnchorFile, read_anchors
from mipmap_plugin.models.anchors.model import AnchorModel
from mipmap_plugin.models.anchors.networks import inputs_of, surplus

# Rounding of a distance to a level, by `dist2level` of cfg_args. Progressive levels fade in.
TO_LEVEL = {"floor": torch.floor, "round": torch.round, "ceil": torch.ceil}
PROGRESSIVE = "progressive"
MAX_LEVELS, MAX_FORK = 100, 1000  # published models have 5 to 20 levels, each 2 times finer
ALMOST_ONE = 0.9999  # the original's: progressive levels are clamped just short of the next one


class OctreeModel(AnchorModel):
    """Anchors of level 0 are the coarsest. `Camera.zoom` is 1 / the original's `resolution_scale`; distances count beside it."""

    family = "octree"

    def __init__(self, read: AnchorFile, inputs: dict[str, tuple[str, ...]], fork: float, to_level: str) -> None:
        """`fork`: ratio of resolutions of successive levels; `to_level`: a key of TO_LEVEL, or PROGRESSIVE."""
        self._fork, self._to_level = fork, to_level
        # The original keeps two constants in the first rows of a column (scene/gaussian_model.py, save_ply).
        self._voxel_size, self._standard_distance = (float(value) for value in read.first["info"])
        super().__init__(read, inputs)
        levels = self._column("level")
        self._levels = int(levels.max() - levels.min()) + 1
        if self._levels > MAX_LEVELS:
            raise CheckpointError(f"{self.source}: its anchors lie in {self._levels:,} levels of detail; the file is damaged, so export it again")
        if self._levels > 1:
            self._shrink_option = "resolution_scales"  # -r makes pictures smaller, and leaves the levels as they are (utils/camera_utils.py)
        self.notes.append(f"{plural(self._levels, 'level')} of detail, chosen by distance and zoom ({to_level}, each {fork:g} times finer)")

    def _effects(self) -> tuple[Effect, ...]:
        reason = f"{self._levels} of them, chosen by distance and zoom ({self._to_level})"
        return (*super()._effects(), Effect("levels of detail", self._levels > 1, reason, f"a distance and a logarithm an anchor, of {len(self):,}"))

    def wanted_levels(self, camera: Camera) -> Tensor:
        """The level that `camera` requires at each anchor, [N], fractional if levels fade."""
        level, extra = self._column("level", "extra_level").unbind(1)
        corner = self._parameters["means"].detach() + (self._voxel_size / 2) / self._fork ** level[:, None]
        distance = (corner - camera.center.to(corner)).norm(dim=1) / camera.zoom
        wanted = torch.log2(self._standard_distance / distance) / math.log2(self._fork) + extra
        if self._to_level == PROGRESSIVE:
            return (wanted + 1).clamp(ALMOST_ONE, self._levels - 1 + ALMOST_ONE)
        return TO_LEVEL[self._to_level](wanted).clamp(0, self._levels - 1)

    def row_opacities(self, views: Sequence[Camera]) -> Tensor:
        """As for other anchors, [N], but 1 for one anchor of the coarsest level, and for two in all, so that they are never pruned.

        The original numbers levels from the coarsest in the file (scene/gaussian_model.py, load_ply_sparse_gaussian) and shows none
        above their count: without the coarsest level it would lose the finest. Its constants need two rows.
        """
        opacities, levels = super().row_opacities(views), self._column("level")[:, 0]
        opacities[opacities.where(levels == levels.min(), -1.0).argmax()] = 1.0
        opacities[opacities.topk(min(2, len(opacities))).indices] = 1.0
        return opacities

    def thin(self, keep: Tensor) -> None:
        """As for other anchors, but the first of the coarsest level stays, and two in all, for the reasons of `row_opacities`."""
        levels, keep = self._column("level")[:, 0], keep.clone()
        keep[levels.argmin()] = True
        keep[:2] |= keep.sum() < 2
        super().thin(keep)

    def _chosen(self, camera: Camera) -> Tensor:
        return self._column("level")[:, 0] <= self.wanted_levels(camera).floor()

    def _anchors(self, rows: Tensor | slice, camera: Camera | None) -> Anchors:
        levels = self._column("level")[rows]
        anchors = replace(super()._anchors(rows, camera), levels=levels)
        if camera is None or self._to_level != PROGRESSIVE:
            return anchors
        wanted = self.wanted_levels(camera)[rows, None]
        return replace(anchors, fading=torch.where(levels == wanted.floor(), wanted.frac(), 1.0))

    def _second_columns(self) -> dict[str, np.ndarray]:
        if len(self) < 2:
            raise SettingsError("a file of Octree-GS needs two anchors to hold its constants, but only one is left; prune less")
        info = np.zeros(len(self), np.float32)
        info[:2] = self._voxel_size, self._standard_distance
        levels = self._column("level", "extra_level").cpu().numpy()
        return {"level": levels[:, 0], "extra_level": levels[:, 1], "info": info}

    def _cfg_options(self) -> dict[str, Any]:
        level = any("level" in names for names in self._inputs.values())
        grid = {"fork": self._fork, "extend": 1.1, "dist2level": self._to_level, "base_layer": -1, "levels": self._levels, "extra_ratio": 0.25}
        return {**super()._cfg_options(), "add_level": level, **grid, "resolution_scales": [1.0], "random_background": False}


def load_octree(path: str | Path, *, iteration: int | None = None) -> OctreeModel:
    """Load an Octree-GS model folder, or its PLY with the networks beside it.

    Which networks take a distance or a level follows from their shapes and, if these are ambiguous, from cfg_args.
    Raises CheckpointError.
    """
    read = read_anchors(path, "octree", iteration)
    if len(read.first["info"]) < 2 or not all(math.isfinite(value) and value > 0 for value in read.first["info"]):
        raise CheckpointError(f"{read.origin.source}: the first two values of `info` are no voxel size and standard distance; export it again")
    fork, to_level = read.options.get("fork", 2), read.options.get("dist2level", "round")
    if not isinstance(fork, (int, float)) or not 1 < fork <= MAX_FORK or to_level not in (*TO_LEVEL, PROGRESSIVE):
        raise CheckpointError(f"{read.origin.source}: cfg_args has fork={fork!r} and dist2level={to_level!r}, which make no levels")
    model = OctreeModel(read, _inputs(read), fork, to_level)
    if "dist2level" not in read.options:
        model.notes.append("no cfg_args tells how levels are chosen; the original's defaults are taken: fork 2, round")
    return model


def _inputs(read: AnchorFile) -> dict[str, tuple[str, ...]]:
    """The inputs of each network. Raises CheckpointError for widths that fit none, or that may mean two things."""
    features = read.parameters["features"].shape[1]
    level = _takes_level(read, [surplus(read.weights, name, features) for name in NEEDED])
    return inputs_of(read.weights, features, ("direction", *("level",) * level), read.origin.source, level=level)


def _takes_level(read: AnchorFile, extras: Sequence[int]) -> bool:
    """Whether all networks take the level, or none. `extras`: the number of their inputs besides features, direction and appearance.

    One additional input may be a distance or a level; other facts may decide.
    """
    if "feature_bank_mlp" in read.weights:
        return surplus(read.weights, "feature_bank_mlp", 0) == 1
    if 0 in extras:
        return False
    if max(extras) > 1:
        return True
    if "add_level" in read.options:
        return bool(read.options["add_level"])
    raise CheckpointError(
        f"{read.origin.source}: its networks take one number more, which may be the distance or the level; put the cfg_args of its training beside it"
    )
