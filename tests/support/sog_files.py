"""Splats for SOG files, and a reader of these."""

import io
import json
import zipfile

import numpy as np
from PIL import Image


def columns_of(count=300, degree=3, seed=0):
    """Splats as a capture has them: a few large ones, many small ones."""
    draw = np.random.default_rng(seed)
    names = [*"xyz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1)))]
    columns = {name: draw.normal(0, 0.3, count) for name in [*names, *(f"rot_{i}" for i in range(4))]}
    columns |= {f"scale_{i}": draw.normal(-7, 1, count) + 9 * (np.arange(count) < 5) for i in range(3)}
    return {name: column.astype(np.float32) for name, column in (columns | {"opacity": draw.normal(0, 2, count)}).items()}


def as_rgba(webp):
    return np.asarray(Image.open(io.BytesIO(webp)).convert("RGBA")).astype(int)


def read_sog(path):
    """The columns of a SOG, and its meta.json."""
    with zipfile.ZipFile(path) as archive:
        assert all((info.compress_type, info.external_attr >> 16) == (zipfile.ZIP_STORED, 0o644) for info in archive.infolist())
        return decoded({name: archive.read(name) for name in archive.namelist()})


def read_unpacked(folder):
    """The same of a SOG that lies in a folder."""
    return decoded({file.name: file.read_bytes() for file in folder.iterdir()})


def decoded(contents):
    """The columns of a SOG by its specification, and its meta.json."""
    meta = json.loads(contents["meta.json"])
    images = {name: as_rgba(content) for name, content in contents.items() if name.endswith("webp")}
    flat = {name: image.reshape(-1, 4)[: meta["count"]] for name, image in images.items()}
    low, high = (np.array(meta["means"][end]) for end in ("mins", "maxs"))
    logs = low + (high - low) * (flat["means_l.webp"] + 256 * flat["means_u.webp"])[:, :3] / 65535
    found = dict(zip("xyz", (np.sign(logs) * np.expm1(np.abs(logs))).T, strict=True))
    scales, colors = (np.array(meta[part]["codebook"])[flat[f"{part}.webp"][:, :3]] for part in ("scales", "sh0"))
    found |= {f"{name}_{i}": values[:, i] for name, values in (("scale", scales), ("f_dc", colors)) for i in range(3)}
    found["alpha"] = flat["sh0.webp"][:, 3] / 255
    three = (flat["quats.webp"][:, :3] / 255 - 0.5) * np.sqrt(2)
    left = np.sqrt(np.maximum(0, 1 - (three**2).sum(1)))
    found["quats"] = np.stack([np.insert(own, tag, value) for own, tag, value in zip(three, flat["quats.webp"][:, 3] - 252, left, strict=True)])
    if "shN" in meta:
        each = (meta["shN"]["bands"] + 1) ** 2 - 1
        table = np.array(meta["shN"]["codebook"])[images["shN_centroids.webp"].reshape(-1, each, 4)[: meta["shN"]["count"], :, :3]]
        labels = flat["shN_labels.webp"][:, 0] + 256 * flat["shN_labels.webp"][:, 1]
        found |= {f"f_rest_{i}": rest for i, rest in enumerate(table[labels].swapaxes(1, 2).reshape(meta["count"], -1).T)}
    return found, meta


def matched(columns, found):
    """The rows of a file in the order of its splats."""
    places, read = (np.stack([rows[axis] for axis in "xyz"], 1) for rows in (columns, found))
    nearest = ((places[:, None] - read[None]) ** 2).sum(2).argmin(1)
    assert len(set(nearest)) == len(places)
    return {name: column[nearest] for name, column in found.items()}
