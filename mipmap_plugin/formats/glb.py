"""Writes splats as binary glTF (KHR_gaussian_splatting, KhronosGroup/glTF) in float32, which PlayCanvas, three.js and Babylon.js read."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mipmap_plugin.errors import OutputError
from mipmap_plugin.formats.atomic import new_file
from mipmap_plugin.formats.gltf import BINARY_CHUNK, DISPLAY, JSON_CHUNK, MAGIC, MODE, SPLATTING
from mipmap_plugin.formats.tags import render_mode

# glTF's code of float32, and what its vectors are called by their lengths.
FLOAT, VECTORS = 5126, {1: "SCALAR", 3: "VEC3", 4: "VEC4"}

# Bytes of the splats in one file, whose length has 32 bits: 18 million of SH degree 3.
MOST_BYTES = 2**32 - 2**16


def write_glb(path: Path, columns: Mapping[str, np.ndarray], comments: Iterable[str] = (), *, overwrite: bool = False) -> Path:
    """Write the columns of a 3DGS PLY, [N] each and finite, as one mesh, atomically; return `path`. Raises OutputExists, OutputError.

    `comments`: of that PLY; how they say that it is to be drawn (`render_mode`) is written, if it is not as usual.

    All is turned by half a turn about z: glTF has y up, and a PLY mostly y down.
    """
    named = {"POSITION": _stacked([-columns["x"], -columns["y"], columns["z"]])}
    w, x, y, z = _unit(_stacked([columns[f"rot_{i}"] for i in range(4)])).T
    named[f"{SPLATTING}:ROTATION"] = _stacked([-y, x, w, -z])  # half a turn about z, after the splat's own
    named[f"{SPLATTING}:SCALE"] = np.exp(_stacked([columns[f"scale_{i}"] for i in range(3)]))
    named[f"{SPLATTING}:OPACITY"] = _stacked([1 / (1 + np.exp(-columns["opacity"].astype(np.float64)))])
    named[f"{SPLATTING}:SH_DEGREE_0_COEF_0"] = _stacked([columns[f"f_dc_{i}"] for i in range(3)])
    bands = sum(name.startswith("f_rest_") for name in columns) // 3
    for number in range(1, bands + 1):
        degree = math.isqrt(number)
        order = number - degree**2 - degree
        sign = -1 if order % 2 else 1  # harmonics of odd orders are odd in x and y together
        named[f"{SPLATTING}:SH_DEGREE_{degree}_COEF_{degree + order}"] = _stacked(
            [sign * columns[f"f_rest_{channel * bands + number - 1}"] for channel in range(3)]
        )
    size = sum(array.nbytes for array in named.values())
    if size > MOST_BYTES:
        raise OutputError(f"{path}: a .glb holds at most 4 GiB, and these {len(named['POSITION']):,} splats take {size / 2**30:.1f}; give a .ply")
    with new_file(path, overwrite) as temporary, temporary.open("wb") as file:
        file.write(before_binary(_document(named, {"antialiased": "mip", "2dgs": "2dgs"}.get(render_mode(comments) or "")), size))
        for array in named.values():
            file.write(array.tobytes())
    return path


def before_binary(document: dict[str, Any], size: int) -> bytes:
    """What a GLB begins with: all before its binary chunk, of `size` bytes, a multiple of 4."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", MAGIC, 2, 12 + 8 + len(text) + 8 + size)
    return head + struct.pack("<I4s", len(text), JSON_CHUNK) + text + struct.pack("<I4s", size, BINARY_CHUNK)


def bytes_before_binary(path: Path) -> int:
    """The length of what `before_binary` wrote into a file."""
    with path.open("rb") as file:
        return 12 + 8 + int(struct.unpack("<12xI", file.read(16))[0]) + 8


def _document(named: Mapping[str, np.ndarray], mode: str | None) -> dict[str, Any]:
    """The JSON of one mesh with these attributes, whose bytes follow one another, and of how it is to be drawn."""
    starts = np.cumsum([0, *(array.nbytes for array in named.values())]).tolist()
    accessors: list[dict[str, Any]] = [
        {"bufferView": number, "componentType": FLOAT, "count": len(array), "type": VECTORS[array.shape[1]]}
        for number, array in enumerate(named.values())
    ]
    accessors[0] |= {"min": named["POSITION"].min(axis=0).tolist(), "max": named["POSITION"].max(axis=0).tolist()}
    splatting = {"kernel": "ellipse", "colorSpace": DISPLAY[0], "sortingMethod": "cameraDistance", "projection": "perspective"}
    primitive = {"mode": 0, "attributes": {name: number for number, name in enumerate(named)}, "extensions": {SPLATTING: splatting}}
    return {
        "asset": {"version": "2.0", "generator": "mipmap_plugin", **({"extras": {MODE: mode}} if mode else {})}, "extensionsUsed": [SPLATTING],
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}], "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteOffset": start, "byteLength": end - start} for start, end in pairwise(starts)],
        "buffers": [{"byteLength": starts[-1]}],
    }  # fmt: skip


def _stacked(columns: list[np.ndarray]) -> np.ndarray:
    return np.stack(columns, axis=1).astype("<f4")


def _unit(quats: np.ndarray) -> np.ndarray:
    """Quaternions wxyz [N, 4] of length 1; a zero quaternion becomes the identity."""
    length = np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)
    unit: np.ndarray = np.where(length > 0, quats / np.where(length > 0, length, 1), (1.0, 0.0, 0.0, 0.0))
    return unit
