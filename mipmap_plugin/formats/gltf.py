"""Gaussian splats in glTF 2.0, binary (.glb) or as JSON (.gltf), by the extension KHR_gaussian_splatting (KhronosGroup/glTF).

Older drafts are read as well: their attributes are named otherwise, and their splats may be SPZ. Buffers are read from the file itself, from
data URIs and from files in its folder, and nothing is executed.
"""

from __future__ import annotations

import base64
import json
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from mipmap_plugin.errors import CheckpointError, brief

SPLATTING = "KHR_gaussian_splatting"

# Extensions by which a primitive keeps its splats as an SPZ file: inside SPLATTING, and of a draft before it, by itself.
SPZ_INSIDE = ("KHR_gaussian_splatting_compression_spz_2", "KHR_gaussian_splatting_compression_spz")
SPZ_ITSELF = "KHR_spz_gaussian_splats_compression"

# Display colors, as the extension calls them, and as its drafts did. Splats are blended in their own colors, and only pictures are encoded for a
# display: half of white over black is 0.5 in linear light, which a display shows as 0.74, whatever is made of the colors of the two.
DISPLAY = ("srgb_rec709_display", "bt.709-srgb", "bt.709")

# Attributes that splats are made of, after a prefix; files have others, for viewers that draw points.
NEEDED = re.compile(r"POSITION|ROTATION|SCALE|OPACITY|COLOR_0|SH_DEGREE_\d+_COEF_\d+")

# How often the nodes of a scene may repeat splats in the mean, each time as splats of their own: more would fill the memory.
MOST_TIMES = 100

# Codes of types of numbers and of vectors, the magic number of a GLB, and its two kinds of chunks.
NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
LENGTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
MAGIC, JSON_CHUNK, BINARY_CHUNK = b"glTF", b"JSON", b"BIN\0"

# What `formats.glb` calls the way in which splats are to be drawn, for which glTF has no word, among the further facts about a file.
MODE = "SplatRenderMode"

# Whatever a damaged document makes of the code that follows its references.
DAMAGE = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, RecursionError, struct.error)


@dataclass(frozen=True)
class Splats:
    """The splats of one primitive.

    Attributes:
        matrix: [4, 4] f8, from their coordinates to those of the scene, which has y up.
        attributes: Arrays [N, ...] f4 by their names without a prefix: POSITION, ROTATION (xyzw), SCALE, OPACITY, SH_DEGREE_0_COEF_0, COLOR_0, ...
        spz: The bytes of an SPZ file that holds them instead; None: none does.
        mode: How they are to be drawn, as comments of a PLY say it; None: the file does not say.
    """

    matrix: np.ndarray
    attributes: dict[str, np.ndarray] = field(default_factory=dict)
    spz: bytes | None = None
    mode: str | None = None


def read_gltf(path: Path) -> tuple[list[Splats], list[Path]]:
    """The splats of all primitives in a file's scene, and the files that they are in.

    Raises CheckpointError for a file that is damaged, has none, or keeps them in a way that is not read.
    """
    try:
        document = _Document(path)
        splats = list(document.splats())
    except CheckpointError:
        raise
    except KeyError as error:
        raise CheckpointError(f"{path} is a damaged glTF file, which lacks {error}; download or export it again") from error
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror or error}; check who may read it, and the files that it names") from error
    except DAMAGE as error:
        raise CheckpointError(f"{path} is a damaged glTF file ({brief(error)}); download or export it again") from error
    if not splats:
        raise CheckpointError(f"{path} is glTF without Gaussian splats ({SPLATTING}): meshes or points; give a trained model")
    return splats, [path, *document.files]


class _Document:
    def __init__(self, path: Path) -> None:
        self._path = path
        self.files: list[Path] = []  # besides that one
        text, self._binary = _chunks(path)
        self._json: dict[str, Any] = json.loads(bytes(text))
        self._buffers: dict[int, memoryview] = {}

    def splats(self) -> Iterator[Splats]:
        meshes = [list(filter(_is_of_splats, mesh["primitives"])) for mesh in self._json.get("meshes", [])]
        placed = [(primitive, matrix) for node, matrix in self._nodes() if "mesh" in node for primitive in meshes[node["mesh"]]]
        if len(placed) > MOST_TIMES * sum(map(len, meshes)):
            raise CheckpointError(f"{self._path}: its nodes repeat splats {len(placed):,} times, which is not read here; export it as a PLY")
        for primitive, matrix in placed:
            yield self._primitive(primitive["attributes"], primitive["extensions"], matrix)

    def _nodes(self) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
        """The nodes of the scene, each with its matrix to the scene; all nodes that no other holds where there is no scene."""
        nodes = self._json.get("nodes", [])
        scenes = self._json.get("scenes", [])
        held = {child for node in nodes for child in node.get("children", [])}
        roots = scenes[self._json.get("scene", 0)].get("nodes", []) if scenes else [i for i in range(len(nodes)) if i not in held]
        left, seen = [(i, np.eye(4)) for i in roots], set[int]()
        while left:
            number, parent = left.pop(0)
            if number in seen:
                raise ValueError(f"node {number} lies in two others")
            seen.add(number)
            matrix = parent @ _matrix(nodes[number])
            yield nodes[number], matrix
            left += [(child, matrix) for child in nodes[number].get("children", [])]

    def _primitive(self, attributes: dict[str, int], extensions: dict[str, Any], matrix: np.ndarray) -> Splats:
        said = extensions.get(SPLATTING, {})
        self._refuse(said)
        inside = said.get("extensions", {})
        compression = next((inside[name] for name in SPZ_INSIDE if name in inside), extensions.get(SPZ_ITSELF))
        if compression is not None:
            return Splats(matrix, spz=bytes(self._view(compression["bufferView"])))
        named = {name.removeprefix(f"{SPLATTING}:").removeprefix("_"): index for name, index in attributes.items()}
        arrays = {name: self._array(index) for name, index in named.items() if NEEDED.fullmatch(name)}
        facts = self._json.get("asset", {}).get("extras")
        mode = facts.get(MODE) if isinstance(facts, dict) else None
        return Splats(matrix, arrays, mode=mode if isinstance(mode, str) else None)

    def _refuse(self, said: dict[str, Any]) -> None:
        """Raise CheckpointError for splats that are no Gaussians in display colors, as the extension's basis describes them."""
        if (kernel := said.get("kernel", "ellipse")) != "ellipse":
            raise CheckpointError(f"{self._path}: its splats have the kernel {kernel!r}, and only 'ellipse' is read; export it as a PLY of 3DGS")
        if (space := said.get("colorSpace", DISPLAY[0])).lower() not in DISPLAY:
            why = "in which its splats are blended too, so that no others look the same"
            remedy = f"if it was trained on photographs as they are, export it with {DISPLAY[0]!r}, or as a PLY"
            raise CheckpointError(f"{self._path}: its colors are in {space!r}, {why}; {remedy}")
        known = (*SPZ_INSIDE, SPZ_ITSELF)
        if unknown := [name for name in said.get("extensions", {}) if name not in known and name in self._json.get("extensionsRequired", [])]:
            raise CheckpointError(f"{self._path}: its splats are kept by {unknown[0]}, which is not read here; export it as a PLY")

    def _array(self, index: int) -> np.ndarray:
        """An accessor's numbers [count, ...] as f4; whole numbers that are normalized as fractions of the largest."""
        accessor = self._json["accessors"][index]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise CheckpointError(f"{self._path}: its accessor {index} is sparse or compressed, which is not read here; export it as a PLY")
        view, number = self._json["bufferViews"][accessor["bufferView"]], np.dtype(NUMBERS[accessor["componentType"]])
        if "EXT_meshopt_compression" in view.get("extensions", {}) or "KHR_meshopt_compression" in view.get("extensions", {}):
            raise CheckpointError(f"{self._path}: it is compressed by meshopt, which is not read here; export it without, or as a PLY")
        length = LENGTHS[accessor["type"]]
        stride = view.get("byteStride", length * number.itemsize)
        if stride < length * number.itemsize:
            raise ValueError(f"the rows of view {accessor['bufferView']} overlap")
        data = self._view(accessor["bufferView"])
        array = np.ndarray((accessor["count"], length), number, data, accessor.get("byteOffset", 0), (stride, number.itemsize))
        values: np.ndarray = array.astype(np.float32)
        if accessor.get("normalized") and number.kind in "iu":
            values = np.maximum(values / np.float32(np.iinfo(number).max), -1)
        return values[:, 0] if length == 1 else values

    def _view(self, index: int) -> memoryview:
        view = self._json["bufferViews"][index]
        start, length = view.get("byteOffset", 0), view["byteLength"]
        data = self._buffer(view["buffer"])[start : start + length]
        if min(start, length) < 0 or len(data) < length:
            raise ValueError(f"buffer {view['buffer']} ends before its view {index}")
        return data

    def _buffer(self, index: int) -> memoryview:
        if index not in self._buffers:
            uri = self._json["buffers"][index].get("uri")
            if uri is None and index:
                raise ValueError(f"buffer {index} is nowhere")
            self._buffers[index] = self._binary if uri is None else memoryview(self._from_uri(uri))
        return self._buffers[index]

    def _from_uri(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            return base64.b64decode(uri[uri.index(";base64,") + len(";base64,") :])
        if any(sign in unquote(uri) for sign in "/\\:"):
            raise CheckpointError(f"{self._path}: its buffer {uri[:80]!r} does not lie in its folder; put it there, or export a .glb")
        file = self._path.with_name(unquote(uri))
        if not file.is_file():
            raise CheckpointError(f"{self._path} lacks its buffer {file.name}; put that file beside it, or export a .glb")
        self.files.append(file)
        return file.read_bytes()


def _is_of_splats(primitive: dict[str, Any]) -> bool:
    return bool({SPLATTING, SPZ_ITSELF} & primitive.get("extensions", {}).keys())


def _chunks(path: Path) -> tuple[memoryview, memoryview]:
    """The JSON and the binary chunk of a file; the latter is empty for a .gltf."""
    data = memoryview(path.read_bytes())
    if data[:4] != MAGIC:
        return data, data[:0]
    _, version, length = struct.unpack_from("<4sII", data)
    if version != 2:
        raise CheckpointError(f"{path} is glTF of version {version}, and only 2 is read; export it again")
    if length > len(data):
        raise ValueError(f"{len(data):,} of its {length:,} bytes are left")
    found: dict[bytes, memoryview] = {}
    place = 12
    while place + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, place)
        found.setdefault(kind, data[place + 8 : place + 8 + size])
        place += 8 + size
    return found[JSON_CHUNK], found.get(BINARY_CHUNK, data[:0])


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """A node's matrix [4, 4], given column by column, or as translation, rotation (xyzw) and scale."""
    if "matrix" in node:
        columns: np.ndarray = np.array(node["matrix"], np.float64).reshape(4, 4)
        return np.ascontiguousarray(columns.T)
    quat: np.ndarray = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    x, y, z, w = quat / np.linalg.norm(quat)
    turn = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    matrix: np.ndarray = np.eye(4)
    matrix[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix
