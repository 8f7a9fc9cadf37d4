"""3D Tiles of the real splat-transform: the box of the tileset is where the splats of a tile lie."""

import gzip
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch
from browser import HERE

from mipmap_plugin.formats.splat_transform import TOOL, find_tool
from mipmap_plugin.levels.tiles import bounding_box, bounds, write_tile
from mipmap_plugin.models.vanilla import VanillaModel

pytestmark = pytest.mark.browser


def positions(glb: Path) -> np.ndarray:
    """[N, 3]: where the centers of the SPZ in a tile lie in it: turned by the node's matrix, and then as 3D Tiles, whose z is up, read a glTF's
    (x, y, z), as (x, -z, y): specification 1.1, "glTF transforms". SPZ 3: 24 bits each, after a header of 16 bytes."""
    content = glb.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    spz = gzip.decompress(content[28 + length :][: document["buffers"][0]["byteLength"]])
    (count,), fraction = struct.unpack_from("<I", spz, 8), spz[13]
    parts = np.frombuffer(spz, np.uint8, 9 * count, 16).reshape(count, 3, 3).astype(np.int32)
    whole = parts @ np.array([1, 1 << 8, 1 << 16])
    centers = np.where(whole >= 1 << 23, whole - (1 << 24), whole) / (1 << fraction)
    x, y, z = (centers @ np.array(document["nodes"][0]["matrix"]).reshape(4, 4)[:3, :3]).T
    return np.stack([x, -z, y], axis=1)


def test_the_box_is_where_splat_transform_puts_the_splats(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(HERE / "node_modules" / ".bin"), prepend=":")
    if not find_tool():
        pytest.skip(f"{TOOL} is not installed; `npm ci` in tests/browser brings it")
    ball = tiny.gaussians()
    offset = ball.means.new_tensor([14.0, 21.0, 32.0])
    model = VanillaModel.from_gaussians(replace(ball, means=ball.means * torch.tensor([1.0, 2.0, 4.0]) + offset))
    model.save(tmp_path / "base.ply", provenance={})
    write_tile(tmp_path / "base.ply", tmp_path / "base.glb")
    found, box = positions(tmp_path / "base.glb"), bounding_box(*bounds([model]))
    for axis in range(3):
        center, half = box[axis], box[3 + 4 * axis]
        low, high = found[:, axis].min(), found[:, axis].max()
        assert center - half < low and high < center + half
        assert 2 * half < 4 * (high - low)  # a box around these splats, not around all of space
