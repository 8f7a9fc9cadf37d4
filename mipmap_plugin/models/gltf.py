"""Splats in glTF (KHR_gaussian_splatting), which viewers of maps and of the web read."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.errors import TEMPORARY, CheckpointError, ShapeError, brief
from mipmap_plugin.formats.atomic import sha256
from mipmap_plugin.formats.gltf import read_gltf
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.splat_transform import as_ply
from mipmap_plugin.models.columns import to_parameters
from mipmap_plugin.models.detect import detect_as
from mipmap_plugin.models.health import without_invalid
from mipmap_plugin.models.raw import check, log, logit
from mipmap_plugin.models.vanilla import Origin, VanillaModel
from mipmap_plugin.splatting.harmonics import C0, rotated
from mipmap_plugin.splatting.rotations import quaternion_product, quaternions

# glTF has y up, and a PLY mostly y down: half a turn about z lies between them, as in splat-transform.
FROM_SCENE = np.diag([-1.0, -1.0, 1.0, 1.0])

# Relative differences between the axes of a node's matrix, and from right angles, that are taken for rounding.
UNEVEN = 1e-4


def load_gltf(path: str | Path, *, iteration: int | None = None) -> VanillaModel:
    """Load the splats of a .glb or .gltf, in the frame of a PLY. Raises CheckpointError."""
    file = detect_as(path, ("gltf",), iteration=iteration).path
    parts, compressed = [], False
    for splats in read_gltf(file):
        raw = _from_spz(splats.spz, file) if splats.spz else _raw(splats.attributes, file)
        parts.append(_placed(raw, FROM_SCENE @ splats.matrix, file))
        compressed |= bool(splats.spz)
    notes = ["read from glTF, and turned from y up to the frame of a PLY"]
    notes += ["SPZ in it rounds the trained values: the base is what its viewers show"] if compressed else []
    return without_invalid(VanillaModel(_joined(parts), origin=Origin(file, sha256(file)), notes=notes))


def _raw(attributes: dict[str, np.ndarray], file: Path) -> dict[str, Tensor]:
    """Raw parameters (`columns.to_parameters`) of a primitive's attributes. Raises CheckpointError for missing ones and wrong shapes.

    In drafts opacities and colors were those of COLOR_0, and sizes logarithms: those that are now kept are not negative.
    """
    values = {name: torch.from_numpy(array) for name, array in attributes.items()}
    needed = ("POSITION", "ROTATION", "SCALE", *(() if {"OPACITY", "SH_DEGREE_0_COEF_0"} <= values.keys() else ("COLOR_0",)))
    if missing := [name for name in needed if name not in values]:
        raise CheckpointError(f"{file} is no whole scene of splats: it lacks {', '.join(missing)}; export it again with them")
    try:
        scales = values["SCALE"]
        opacities = values["OPACITY"] if "OPACITY" in values else values["COLOR_0"][:, 3]
        sh0 = values["SH_DEGREE_0_COEF_0"] if "SH_DEGREE_0_COEF_0" in values else (values["COLOR_0"][:, :3] - 0.5) / C0
        sh = torch.stack([sh0, *_bands(values)], dim=1)
        raw = {
            "means": values["POSITION"],
            "scales": scales if (scales < 0).any() else log(scales),
            "quats": values["ROTATION"][:, [3, 0, 1, 2]],
            "opacities": logit(opacities),
            "sh0": sh[:, :1],
            "shN": sh[:, 1:],
        }
        check(raw)
    except (IndexError, RuntimeError, ShapeError) as error:
        raise CheckpointError(f"{file} is damaged: its attributes do not fit each other ({brief(error)}); download or export it again") from error
    return raw


def _bands(values: dict[str, Tensor]) -> list[Tensor]:
    """The coefficients of whole degrees from 1 on, [N, 3] each."""
    bands: list[Tensor] = []
    for degree in (1, 2, 3):
        names = [f"SH_DEGREE_{degree}_COEF_{n}" for n in range(2 * degree + 1)]
        if not all(name in values for name in names):
            break
        bands += [values[name] for name in names]
    return bands


def _from_spz(spz: bytes, file: Path) -> dict[str, Tensor]:
    """Raw parameters of an SPZ file, in the axes that it is stored in."""
    with tempfile.TemporaryDirectory(prefix=TEMPORARY) as folder:
        source = Path(folder, "source.spz")
        source.write_bytes(spz)
        try:
            with as_ply(source, "spz") as ply:
                raw = to_parameters(read_ply(ply).columns, file)
        except CheckpointError as error:
            raise CheckpointError(str(error).replace(str(source), f"{file}: what it holds")) from error
    return raw | {"opacities": logit(raw["opacities"].sigmoid())}  # of 8-bit opacities 0 and 1 the logits are infinite


def _placed(raw: dict[str, Tensor], matrix: np.ndarray, file: Path) -> dict[str, Tensor]:
    """The splats moved by a matrix [4, 4] that turns, moves and scales evenly. Raises CheckpointError for any other."""
    with np.errstate(all="ignore"):  # of numbers that are too large
        size = np.cbrt(np.linalg.det(matrix[:3, :3]))
    turn = torch.from_numpy(matrix[:3, :3] / size) if size > 0 else torch.zeros(3, 3, dtype=torch.float64)
    if not bool((turn @ turn.T - torch.eye(3, dtype=torch.float64)).abs().max() < UNEVEN):
        raise CheckpointError(f"{file}: a node mirrors its splats, or stretches them unevenly, which is not read here; export it without")
    quats = quaternions(turn[None]).to(raw["quats"]).expand_as(raw["quats"])
    sh = rotated(torch.cat([raw["sh0"], raw["shN"]], dim=1), turn)
    means = raw["means"].double() @ (size * turn).T + torch.from_numpy(matrix[:3, 3])
    return raw | {
        "means": means.to(raw["means"]), "scales": raw["scales"] + float(np.log(size)), "quats": quaternion_product(quats, raw["quats"]),
        "sh0": sh[:, :1], "shN": sh[:, 1:],
    }  # fmt: skip


def _joined(parts: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """The splats of all primitives, with as many coefficients as the one that has most."""
    most = max(part["shN"].shape[1] for part in parts)
    for part in parts:
        rest = part["shN"]
        part["shN"] = torch.cat([rest, rest.new_zeros(len(rest), most - rest.shape[1], 3)], dim=1)
    return {name: torch.cat([part[name] for part in parts]).contiguous() for name in parts[0]}
