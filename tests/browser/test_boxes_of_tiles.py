"""3D Tiles of the real splat-transform: the box of the tileset is where the splats of a tile lie."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import pytest
import tiny
import torch
from browser import HERE

from mipmap_plugin.formats.splat_transform import TOOL, convert, find_tool
from mipmap_plugin.levels.tiles import bounding_box
from mipmap_plugin.models.vanilla import VanillaModel

pytestmark = pytest.mark.browser


def positions(glb: Path) -> tuple[list[float], list[float]]:
    """The least and the most of the first primitive's positions, of the glTF's accessor."""
    content = glb.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    return accessor["min"], accessor["max"]


def test_the_box_is_where_splat_transform_puts_the_splats(tmp_path, monkeypatch):
    """3D Tiles, whose z is up, read a glTF's (x, y, z) as (x, -z, y): specification 1.1, "glTF transforms"."""
    monkeypatch.setenv("PATH", str(HERE / "node_modules" / ".bin"), prepend=":")
    if not find_tool():
        pytest.skip(f"{TOOL} is not installed; `npm ci` in tests/browser brings it")
    ball = tiny.gaussians()
    offset = ball.means.new_tensor([14.0, 21.0, 32.0])
    model = VanillaModel.from_gaussians(replace(ball, means=ball.means * torch.tensor([1.0, 2.0, 4.0]) + offset))
    model.save(tmp_path / "base.ply", provenance={})
    convert([tmp_path / "base.ply"], tmp_path / "base.glb")
    (x, y, z), (to_x, to_y, to_z) = positions(tmp_path / "base.glb")
    low, high = (x, -to_z, y), (to_x, -z, to_y)
    box = bounding_box(model)
    for axis in range(3):
        center, half = box[axis], box[3 + 4 * axis]
        assert center - half < low[axis] and high[axis] < center + half
        assert 2 * half < 4 * (high[axis] - low[axis])  # a box around these splats, not around all of space
