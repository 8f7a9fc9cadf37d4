"""A small writer of splats in glTF (KHR_gaussian_splatting), for tests."""

import copy
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from mipmap_plugin.gaussians import Gaussians

EXTENSION = "KHR_gaussian_splatting"
CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
DISPLAY = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}


def attributes(splats: Gaussians) -> dict[str, np.ndarray]:
    """What the extension keeps of splats, f4: sizes and opacities as they are drawn, quaternions xyzw."""
    named = {"POSITION": splats.means, f"{EXTENSION}:ROTATION": splats.quats[:, [1, 2, 3, 0]] / splats.quats.norm(dim=1, keepdim=True)}
    named |= {f"{EXTENSION}:SCALE": splats.scales, f"{EXTENSION}:OPACITY": splats.opacities[:, None]}
    degrees = [(degree, n) for degree in range(4) for n in range(2 * degree + 1)]
    named |= {f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}": each for (degree, n), each in zip(degrees, splats.sh.unbind(1), strict=False)}
    return {name: each.numpy() for name, each in named.items()}


def document(*parts: dict[str, np.ndarray], nodes: list[dict[str, Any]] | None = None) -> tuple[dict[str, Any], bytes]:
    """The JSON and the bytes of one primitive for each of `parts`, whose whole numbers are normalized; a mesh each. `nodes`: one for each mesh."""
    made: dict[str, Any] = {"asset": {"version": "2.0"}, "extensionsUsed": [EXTENSION], "accessors": [], "bufferViews": [], "meshes": []}
    data = b""
    for part in parts:
        named = {}
        for name, array in part.items():
            named[name] = len(made["accessors"])
            kind = {"componentType": CODES[array.dtype.str[1:]], "type": TYPES[array.shape[1]], "count": len(array)}
            made["accessors"].append(kind | {"bufferView": len(made["bufferViews"]), "normalized": array.dtype.kind != "f"})
            made["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
            data += array.tobytes()
        made["meshes"].append({"primitives": [{"mode": 0, "attributes": named, "extensions": {EXTENSION: dict(DISPLAY)}}]})
    made["nodes"] = nodes or [{"mesh": number} for number in range(len(parts))]
    children = {child for node in made["nodes"] for child in node.get("children", [])}
    made["scenes"] = [{"nodes": [number for number in range(len(made["nodes"])) if number not in children]}]
    made["buffers"] = [{"byteLength": len(data)}]
    return made, data


def write_glb(path: Path, made: dict[str, Any], data: bytes) -> Path:
    """Write a binary glTF."""
    text = json.dumps(made).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    return path


def glb(path: Path, splats: Gaussians) -> Path:
    """Write splats as one primitive of a binary glTF."""
    return write_glb(path, *document(attributes(splats)))


# Where a primitive says how its splats are meant.
SAID = ("meshes", 0, "primitives", 0, "extensions", EXTENSION)


def changed(made, *path, to):
    """A copy with another value at a place."""
    made = copy.deepcopy(made)
    place = made
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = to
    return made
