"""SOG, version 2 (PlayCanvas): splats in the pixels of lossless WebP images, in a zip archive. It is written, and completed where it lacks a number.

splat-transform writes it as well, but rounds rotations, opacities and places down, looks up spherical harmonics in a table that has as few as half as
many entries as there are splats, and finds it in minutes; of a capture's file that cost up to 9 dB.
"""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.codebooks import codebook, palette
from mipmap_plugin.formats.images import lossless_webp
from mipmap_plugin.formats.tags import DAMAGE, meta_of_sog
from mipmap_plugin.formats.zipped import FULL
from mipmap_plugin.morton import morton_codes

# Entries of the table of spherical harmonics: their numbers have 16 bits, and 64 of them lie in a row.
MOST_ENTRIES, IN_A_ROW = 1 << 16, 64

# The largest stored integers: of a coordinate, and of a number of a rotation or an opacity.
PLACES, LEVELS = 65535, 255

# Unix permissions of unpacked files: all may read them, or a web server could not.
READABLE = 0o644

# Which three numbers of a quaternion (w, x, y, z) are stored where that of each index is the largest, and the byte that says so.
OTHERS, LARGEST_IS_W = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]), 252

# What to do about an unpacked SOG some of whose files are missing.
WHOLE_FOLDER = "copy or download its whole folder again"

# Log scales this far below a splat's longest axis, or below the longest of all, cannot be told apart by the eye, and would only spread the codes.
FLATTEST, SMALLEST = 12.0, 25.0


def write_sog(path: Path, columns: Mapping[str, np.ndarray], *, antialiased: bool) -> None:
    """Write the splats of a 3DGS PLY's columns, of SH degree 3 at most, to a new file."""
    places, *_ = _places(_means(columns))
    order = morton_codes(torch.from_numpy(places)).argsort(stable=True).numpy()  # neighbors beside each other are smaller files
    files, about = _encoded({name: column[order] for name, column in columns.items()})
    meta = {"version": 2, "count": len(order), **({"model": "antialiased"} if antialiased else {}), **about}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in (*files.items(), ("meta.json", json.dumps(meta).encode())):
            entry = zipfile.ZipInfo(name)  # without the time, so that the same splats give the same bytes
            entry.external_attr = READABLE << 16
            archive.writestr(entry, content)


def rewrite_sog(meta: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write the splats of an unpacked SOG, whose meta.json this is, again, from a 3DGS PLY's columns, in the same order."""
    files, about = _encoded(columns)
    for name, content in files.items():
        meta.with_name(name).write_bytes(content)
    meta.write_text(json.dumps(json.loads(meta.read_bytes()) | about), encoding="utf-8")


def _encoded(columns: Mapping[str, np.ndarray]) -> tuple[dict[str, bytes], dict[str, Any]]:
    """The images of a SOG, by their names, of splats in this order, and what its meta.json says of them."""
    opacities = (1 + np.tanh(columns["opacity"].astype(np.float64) / 2)) / 2
    scales = _visible(_stack(columns, "scale_{}", 3).astype(np.float64))
    weights = opacities * np.exp(np.sort(scales - scales.max(), axis=1)[:, 1:].sum(1))  # what a splat covers, where an error shows
    weights = np.maximum(weights / weights.max(), np.finfo(np.float32).tiny) if weights.max() > 0 else np.ones(len(weights))
    places, low, high = _places(_means(columns))
    lengths, length = codebook(scales, np.repeat(weights[:, None], 3, 1))
    colors, color = codebook(_stack(columns, "f_dc_{}", 3), np.repeat(weights[:, None], 3, 1))
    alphas = np.rint(opacities * LEVELS).astype(np.uint8)
    textures = {
        "means_l.webp": (places & 255).astype(np.uint8),
        "means_u.webp": (places >> 8).astype(np.uint8),
        "quats.webp": _rotations(_stack(columns, "rot_{}", 4).astype(np.float64)),
        "scales.webp": length,
        "sh0.webp": np.concatenate([color, alphas[:, None]], 1),
    }
    about: dict[str, Any] = {
        "asset": {"generator": "mipmap_plugin"},
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": lengths.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colors.tolist(), "files": ["sh0.webp"]},
    }
    files = {}
    if rest := sum(name.startswith("f_rest_") for name in columns):
        table, textures["shN_labels.webp"], about["shN"] = _harmonics(_stack(columns, "f_rest_{}", rest), weights)
        files["shN_centroids.webp"] = lossless_webp(table)
    return files | {name: lossless_webp(_image(values)) for name, values in textures.items()}, about


def completed(source: Path, folder: Path) -> Path:
    """A SOG that splat-transform reads, and reads whole: `source`, which is an archive or a meta.json, or a copy of it in `folder`.

    LichtFeld Studio wrote `palette_size` in 2025 for the number of entries in the table of harmonics, `count`, without which splat-transform reads
    harmonics as 0. A folder that was packed as such lies in a folder of its archive. Raises OSError where the disk is full.
    """
    try:
        meta, packed = meta_of_sog(source), zipfile.is_zipfile(source)
        within, table = _folder_in(source) if packed else "", meta.get("shN")
        lacks_count = meta.get("version") == 2 and table and "count" not in table
        if not lacks_count and not within:
            return source
        if lacks_count:
            meta = {**meta, "shN": {**table, "count": table.get("palette_size", MOST_ENTRIES)}}
        if packed:
            return _with_meta(source, folder / "completed.sog", within, json.dumps(meta))
        for name in (Path(name).name for part in meta.values() if isinstance(part, dict) for name in part.get("files", ())):
            shutil.copyfile(source.with_name(name), folder / name)
        copy = folder / source.name
        copy.write_text(json.dumps(meta), encoding="utf-8")
        return copy
    except DAMAGE as error:
        if isinstance(error, OSError) and error.errno in FULL:
            raise  # without its copy the file would be read with wrong colors
        return source  # of which splat-transform tells


def environment_of(streamed: Path) -> list[Path]:
    """The sky and the distance of a Streamed SOG, a SOG of their own, which viewers always show and splat-transform leaves out; empty for none.

    Raises CheckpointError if it is not there. The name is not trusted: splat-transform loads addresses, and executes files of some kinds.
    """
    try:
        name = json.loads(streamed.read_bytes())["environment"]
        environment = (streamed.parent / name).resolve() if name else None
    except DAMAGE:
        return []  # splat-transform tells what is wrong with the file
    if environment is None:
        return []
    trusted = environment.is_relative_to(streamed.parent.resolve()) and (environment.suffix == ".sog" or environment.name == "meta.json")
    if not (trusted and environment.is_file()):
        raise CheckpointError(f"{streamed} names an environment that is missing, {str(name)[:120]}; {WHOLE_FOLDER}")
    return [environment]


def _folder_in(source: Path) -> str:
    """The folder of an archive in which its only SOG lies, with a slash; "" for none, and where there are several."""
    with zipfile.ZipFile(source) as archive:
        folders = [place + slash for place, slash, leaf in (name.rpartition("/") for name in archive.namelist()) if leaf == "meta.json"]
    return folders[0] if len(folders) == 1 else ""


def _with_meta(source: Path, copy: Path, within: str, text: str) -> Path:
    """A copy of what lies in a folder of an archive, with another meta.json."""
    with zipfile.ZipFile(source) as archive, zipfile.ZipFile(copy, "w") as out:
        for name in archive.namelist():
            if name.startswith(within) and name != within:
                out.writestr(name.removeprefix(within), text if name == f"{within}meta.json" else archive.read(name))
    return copy


def _means(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    return np.stack([columns[axis] for axis in "xyz"], 1).astype(np.float64)


def _stack(columns: Mapping[str, np.ndarray], name: str, count: int) -> np.ndarray:
    return np.stack([columns[name.format(number)] for number in range(count)], 1)


def _visible(scales: np.ndarray) -> np.ndarray:
    """Log scales [N, 3], of which those that are too small to tell apart are made equal."""
    longest = scales.max(1, keepdims=True)
    smallest = min(longest.max() - SMALLEST, np.median(longest) - FLATTEST)  # a huge splat must not be what others are compared with
    visible: np.ndarray = np.maximum(scales, np.maximum(longest - FLATTEST, smallest))
    return visible


def _places(means: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centers [N, 3] as integers of 16 bits between the ends of their logarithms, and these ends."""
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    span = np.where(high > low, high - low, 1.0)
    return np.rint((logs - low) / span * PLACES).astype(np.int64), low, high


def _rotations(quats: np.ndarray) -> np.ndarray:
    """Quaternions [N, 4] as three numbers of 8 bits, from -1/√2 to 1/√2, and which one is left out."""
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    quats = np.where(norms > 0, quats / np.where(norms > 0, norms, 1), [1.0, 0.0, 0.0, 0.0])
    largest = np.abs(quats).argmax(1)[:, None]
    signs = np.where(np.take_along_axis(quats, largest, 1) < 0, -1, 1)
    others = np.take_along_axis(quats, OTHERS[largest[:, 0]], 1) * signs
    levels = np.rint((others * np.sqrt(0.5) + 0.5) * LEVELS)
    return np.concatenate([levels, LARGEST_IS_W + largest], 1).astype(np.uint8)


def _harmonics(rest: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """The table of spherical harmonics `rest` [N, 3 C] as an image, the number [N, 2] of each splat's entry in bytes, and what is said of both."""
    # What a splat covers may lie behind others, and nothing here tells: by the roots captures were 0.1 to 0.9 dB closer.
    entries, labels = palette(rest.astype(np.float32), np.sqrt(weights), MOST_ENTRIES)
    count, each = len(entries), rest.shape[1] // 3
    codes, code = codebook(entries, np.ones_like(entries))
    image = np.zeros((-(-count // IN_A_ROW), IN_A_ROW, each, 4), np.uint8)
    image[..., 3] = 255
    image.reshape(-1, each, 4)[:count, :, :3] = code.reshape(count, 3, each).swapaxes(1, 2)
    bands = int((each + 1) ** 0.5) - 1
    about = {"count": count, "bands": bands, "codebook": codes.tolist(), "files": ["shN_centroids.webp", "shN_labels.webp"]}
    return image.reshape(len(image), -1, 4), np.stack([labels & 255, labels >> 8], 1).astype(np.uint8), about


def _image(values: np.ndarray) -> np.ndarray:
    """Bytes [N, 1 to 4] of splats as the pixels of an almost square RGBA image, whose sides are multiples of 4."""
    count = len(values)
    width = -(-int(np.ceil(np.sqrt(count))) // 4) * 4
    image = np.zeros((-(-count // width // 4) * 4 * width, 4), np.uint8)
    image[:count, 3] = 255
    image[:count, : values.shape[1]] = values
    return image.reshape(-1, width, 4)
