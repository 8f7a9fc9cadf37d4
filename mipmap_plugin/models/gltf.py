"""Splats in glTF (KHR_gaussian_splatting), which viewers of maps and of the web read."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.errors import TEMPORARY, CheckpointError, ShapeError, brief
from mipmap_plugin.formats.atomic import sha256
from mipmap_plugin.formats.gltf import MODE, read_gltf
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.splat_transform import as_ply
from mipmap_plugin.models.columns import to_parameters
from mipmap_plugin.models.detect import detect_as
from mipmap_plugin.models.inria_folder import trained_scale
from mipmap_plugin.models.raw import check, log, logit
from mipmap_plugin.models.reading import without_invalid
from mipmap_plugin.models.vanilla import Origin, VanillaModel
from mipmap_plugin.splatting.harmonics import C0, rotated
from mipmap_plugin.splatting.rotations import quaternion_product, quaternions, unit_quaternions

# glTF has y up, and a PLY mostly y down: half a turn about z lies between them, as in splat-transform.
FROM_SCENE = np.diag([-1.0, -1.0, 1.0, 1.0])

# Relative differences between the axes of a node's matrix, and from right angles, that are taken for rounding.
UNEVEN = 1e-4

# So many negative sizes are no errors: they are logarithms, as in drafts, some of which have the names of today; in a scene of large units few are.
LOGARITHMS = 0.01


def load_gltf(path: str | Path, *, iteration: int | None = None) -> VanillaModel:
    """Load the splats of a .glb or .gltf, in the frame of a PLY. Raises CheckpointError."""
    file = detect_as(path, ("gltf",), iteration=iteration).path
    primitives, files = read_gltf(file)
    parts, comments = [], list[tuple[str, ...]]()
    for splats in primitives:
        told = () if splats.mode is None else (f"{MODE}: {splats.mode}",)
        raw, said = (_raw(splats.attributes, file), told) if splats.spz is None else _from_spz(splats.spz, file)
        parts.append(_placed(raw, FROM_SCENE @ splats.matrix, file))
        comments.append(said)
    trained = {trained_scale({}, said) for said in comments}
    if len(trained) > 1:
        raise CheckpointError(f"{file}: its meshes are to be drawn in different ways, which is not read here; export them one by one")
    parameters = _joined(parts)
    if not len(parameters["means"]):
        raise CheckpointError(f"{file} holds no splats; export it again")
    notes = ["read from glTF, and turned from y up to the frame of a PLY"]
    notes += ["SPZ in it rounds the trained values: the base is what its viewers show"] if any(each.spz is not None for each in primitives) else []
    origin = Origin(file, sha256(*files), comments=max(comments, key=len))
    return without_invalid(VanillaModel(parameters, trained.pop(), origin, notes))


def _raw(attributes: dict[str, np.ndarray], file: Path) -> dict[str, Tensor]:
    """Raw parameters (`columns.to_parameters`) of a primitive's attributes. Raises CheckpointError for missing ones and wrong shapes.

    In drafts sizes were logarithms, and in the first opacities and colors were those of COLOR_0.
    """
    values = {name: torch.from_numpy(array) for name, array in attributes.items()}
    needed = ("POSITION", "ROTATION", "SCALE", *(() if {"OPACITY", "SH_DEGREE_0_COEF_0"} <= values.keys() else ("COLOR_0",)))
    if missing := [name for name in needed if name not in values]:
        raise CheckpointError(f"{file} is no whole scene of splats: it lacks {', '.join(missing)}; export it again with them")
    try:
        scales = values["SCALE"]
        opacities = values["OPACITY"] if "OPACITY" in values else values["COLOR_0"][:, 3]
        sh0 = values["SH_DEGREE_0_COEF_0"] if "SH_DEGREE_0_COEF_0" in values else (values["COLOR_0"][:, :3] - 0.5) / C0
        sh = torch.stack([sh0, *_bands(values, file)], dim=1)
        raw = {
            "means": values["POSITION"],
            "scales": scales if (scales < 0).float().mean() > LOGARITHMS else log(scales),
            "quats": values["ROTATION"][:, [3, 0, 1, 2]],
            "opacities": logit(opacities),
            "sh0": sh[:, :1],
            "shN": sh[:, 1:],
        }
        check(raw)
    except (IndexError, RuntimeError, ShapeError) as error:
        raise CheckpointError(f"{file} is damaged: its attributes do not fit each other ({brief(error)}); download or export it again") from error
    return raw


def _bands(values: dict[str, Tensor], file: Path) -> list[Tensor]:
    """The coefficients from degree 1 on, [N, 3] each. Raises CheckpointError for a degree that is not whole, or above 3."""
    names = [f"SH_DEGREE_{degree}_COEF_{n}" for degree in (1, 2, 3) for n in range(2 * degree + 1)]
    found = {name for name in values if name.startswith("SH_DEGREE_")} - {"SH_DEGREE_0_COEF_0"}
    if len(found) not in (0, 3, 8, 15) or found != set(names[: len(found)]):
        raise CheckpointError(f"{file} is damaged: its degrees of spherical harmonics are not whole; export it again")
    return [values[name] for name in names[: len(found)]]


def _from_spz(spz: bytes, file: Path) -> tuple[dict[str, Tensor], tuple[str, ...]]:
    """Raw parameters of an SPZ file, in the axes that it is stored in, and what a PLY says of them: how they are to be drawn."""
    with tempfile.TemporaryDirectory(prefix=TEMPORARY) as folder:
        source = Path(folder, "source.spz")
        source.write_bytes(spz)
        try:
            with as_ply(source, "spz") as converted:
                ply = read_ply(converted)
                raw = to_parameters(ply.columns, file)
        except CheckpointError as error:
            raise CheckpointError(str(error).replace(str(source), f"{file}: what it holds")) from error
    return raw | {"opacities": logit(raw["opacities"].sigmoid())}, ply.comments  # of 8-bit opacities 0 and 1 the logits are infinite


def _placed(raw: dict[str, Tensor], matrix: np.ndarray, file: Path) -> dict[str, Tensor]:
    """The splats moved by a matrix [4, 4] that turns, moves and scales evenly. Raises CheckpointError for any other."""
    with np.errstate(all="ignore"):  # of numbers that are too large
        size = np.cbrt(np.linalg.det(matrix[:3, :3]))
    turn = torch.from_numpy(matrix[:3, :3] / size) if size > 0 else torch.zeros(3, 3, dtype=torch.float64)
    if not bool((turn @ turn.T - torch.eye(3, dtype=torch.float64)).abs().max() < UNEVEN):
        raise CheckpointError(f"{file}: a node mirrors its splats, or stretches them unevenly, which is not read here; export it without")
    quats = quaternion_product(quaternions(turn[None]).to(raw["quats"]).expand_as(raw["quats"]), unit_quaternions(raw["quats"]))
    sh = rotated(torch.cat([raw["sh0"], raw["shN"]], dim=1), turn)
    means = raw["means"].double() @ (size * turn).T + torch.from_numpy(matrix[:3, 3])
    return raw | {
        "means": means.to(raw["means"]), "scales": raw["scales"] + float(np.log(size)), "quats": quats,
        "sh0": sh[:, :1], "shN": sh[:, 1:],
    }  # fmt: skip


def _joined(parts: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """The splats of all primitives, with as many coefficients as the one that has most."""
    most = max(part["shN"].shape[1] for part in parts)
    for part in parts:
        rest = part["shN"]
        part["shN"] = torch.cat([rest, rest.new_zeros(len(rest), most - rest.shape[1], 3)], dim=1)
    return {name: torch.cat([part[name] for part in parts]).contiguous() for name in parts[0]}
