"""Conversion between the columns of a 3DGS PLY and raw parameters. Names and order of the columns are the original project's."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.splatting.harmonics import C0

# Number of f_rest columns -> SH degree.
SH_DEGREES = {0: 0, 9: 1, 24: 2, 45: 3, 72: 4}

# Opacities keep this distance from 0 and 1, whose logits are infinite: far below one step of 8 bits, yet resolved by float32.
OPACITY_MARGIN = 1e-6

# Whole numbers of 8 and 16 bits, which are no logarithms, coefficients or quaternions, but stand for them.
CODES = ("i1", "u1", "i2", "u2")

# Floats above this are no colors in 0..1, not even of lights.
BRIGHTEST = 16

# Of more numbered columns than this, only the first and the last are named.
LISTED = 4

# And so many names of columns are told at most.
TOLD = 8

# Rows that are transposed together: 1 to 2 MB of a file, which stay in the cache while columns are copied.
CHUNK = 8192

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")  # always 0 in 3DGS, and never drawn
GRUT_NORMAL = (0, 0, 1)  # that nv-tlabs/3dgrut writes for every splat, and scier/MetalSplatter
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE = ("scale_0", "scale_1", "scale_2")
QUATERNION = ("rot_0", "rot_1", "rot_2", "rot_3")
RGB, ALPHA = ("red", "green", "blue"), "alpha"
NEEDED = (*POSITION, *DC, "opacity", *SCALE, *QUATERNION)  # without which a file is none of 3DGS
FILTER_3D = "filter_3D"  # of Mip-Splatting and its successors (`models.mip`)


def to_parameters(columns: Mapping[str, np.ndarray], path: Path) -> dict[str, Tensor]:
    """Raw float32 parameters, with gsplat's names and shapes.

    means [N, 3], scales [N, 3] log, quats [N, 4] wxyz, opacities [N] logit, sh0 [N, 1, 3], shN [N, K, 3] basis-major.
    Raises CheckpointError for missing columns, for codes in place of values, and for a number of f_rest columns that fits no SH degree.
    """
    columns = _with_logits(_with_dc(_with_halves(columns)))
    missing = [name for name in NEEDED if name not in columns]
    if missing == [*DC]:
        elsewhere = "its project keeps them in another file, such as a network, which is not read here"
        raise CheckpointError(f"{path} holds splats without colors (f_dc_0, f_dc_1, f_dc_2): {elsewhere}; give a training of 3DGS")
    if missing:
        raise CheckpointError(f"{path} is no 3DGS checkpoint: it lacks the columns {', '.join(missing)}; export it again with them")
    rest = rest_names(columns)
    if codes := [name for name in (*DC, *rest, *SCALE, *QUATERNION) if columns[name].dtype.str[1:] in CODES]:
        why = f"its column {codes[0]} holds whole numbers of {8 * columns[codes[0]].dtype.itemsize} bits, whose meaning it does not say"
        raise CheckpointError(f"{path} is quantized by a program that is not known here: {why}; export it again as floats")
    if len(rest) not in SH_DEGREES:
        raise CheckpointError(f"{path} has {len(rest)} f_rest columns, which fit no SH degree: 0, 9, 24, 45 or 72 do; export it again")
    bands = len(rest) // 3
    basis_major = tuple(rest[c * bands + j] for j in range(bands) for c in range(3))  # the file is channel-major
    sh = stacked(columns, (*DC, *basis_major)).unflatten(1, (1 + bands, 3))  # one tensor: joined without a copy
    return {
        "means": stacked(columns, POSITION),
        "scales": stacked(columns, SCALE),
        "quats": stacked(columns, QUATERNION),
        "opacities": stacked(columns, ("opacity",))[:, 0],
        "sh0": sh[:, :1],
        "shN": sh[:, 1:],
    }


def to_columns(parameters: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """The columns that 3DGS writes, all f4, in its order: views of the parameters, not copies."""
    raw = {name: tensor.detach().to("cpu", torch.float32) for name, tensor in parameters.items()}
    count, bands = raw["shN"].shape[:2]
    rest = tuple(f"f_rest_{i}" for i in range(3 * bands))
    blocks = {
        POSITION: raw["means"],
        NORMAL: torch.zeros(1, 3, dtype=torch.float32, device="cpu").expand(count, 3),
        DC: raw["sh0"][:, 0],
        ("opacity",): raw["opacities"][:, None],
        SCALE: raw["scales"],
        QUATERNION: raw["quats"],
    }
    named = {name: block[:, i].numpy() for names, block in blocks.items() for i, name in enumerate(names)}
    named |= {f"f_rest_{c * bands + j}": raw["shN"][:, j, c].numpy() for c in range(3) for j in range(bands)}
    return {name: named[name] for name in (*POSITION, *NORMAL, *DC, *rest, "opacity", *SCALE, *QUATERNION)}


def extra_columns(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Copies of the columns of `extra_names`, in this machine's byte order."""
    return {name: columns[name].astype(columns[name].dtype.newbyteorder("=")) for name in extra_names(columns)}


def extra_names(columns: Mapping[str, np.ndarray]) -> list[str]:
    """Which of these columns 3DGS does not define, such as a confidence or a segment id; also normals that are not 0, as those of 3DGS are.

    Not a second set of colors: they would no longer be those of the splats, and some viewers prefer them (`second_colors`).
    """
    known = {*NEEDED, *rest_names(columns)}
    known |= set() if any(columns[name].any() for name in NORMAL if name in columns) else set(NORMAL)
    known |= {*RGB, ALPHA} if all(name in columns for name in RGB) else set()
    return [name for name in columns if name not in known]


def notes_on(extras: Mapping[str, np.ndarray]) -> list[str]:
    """What is said of extra columns, in sentences; `filter_3D` has its family's own."""
    names = [name for name in extras if name != FILTER_3D]
    notes = [f"extra columns are carried along: {in_short(names)}"] if names else []
    if all(name in extras and (extras[name] == value).all() for name, value in zip(NORMAL, GRUT_NORMAL, strict=True)):
        kernel = "whose particles are Gaussians only of degree 2, which is not its default"
        notes.append(f"its normals are those that 3DGRUT, MetalSplatter and wgpu-3dgs write: if 3DGRT trained it, {kernel}, it is drawn otherwise")
    return notes


def in_short(names: Iterable[str]) -> str:
    """Names of columns in words, of many that are numbered the first and the last: "segment, semantic_0 to semantic_511"; of others the first."""
    words = []
    for prefix, group in groupby(names, lambda name: re.sub(r"\d+$", "", name)):
        some = list(group)
        words += [f"{some[0]} to {some[-1]}"] if prefix.endswith("_") and len(some) > LISTED else some
    told = ", ".join(words[:TOLD])
    return f"{told} and {len(words) - TOLD} more" if len(words) > TOLD else told


def notes_on_types(columns: Mapping[str, np.ndarray]) -> list[str]:
    """What is said of columns in other types, or of another meaning, than 3DGS gives them, in sentences."""
    whole = _whole_opacities(columns)
    notes = [f"its opacities are whole numbers ({whole}), read as fractions of the largest"] if whole else []
    notes += ["its columns have 16 bits, read as half-precision floats"] if _holds_halves(columns) else []
    notes += [f"its colors are floats above {BRIGHTEST}, read as numbers in 0..255"] if has_bright_colors(columns) else []
    return notes + second_colors(columns)


def second_colors(columns: Iterable[str]) -> list[str]:
    """A note on colors besides those of the harmonics, as Blender writes them; none without both."""
    if not {DC[0], *RGB} <= set(columns):
        return []
    return ["its columns red, green and blue are left out: it has colors without them, and Spark would show a cloud of points, Brush their colors"]


def rest_names(columns: Iterable[str]) -> tuple[str, ...]:
    """The names of the f_rest columns in the order of their numbers."""
    return numbered(columns, "f_rest_")


def numbered(columns: Iterable[str], prefix: str) -> tuple[str, ...]:
    """The columns `prefix`0, `prefix`1, ... sorted by number, which neither the file nor the alphabet guarantees."""
    names = [name for name in columns if re.fullmatch(re.escape(prefix) + r"\d+", name)]
    return tuple(sorted(names, key=lambda name: int(name.removeprefix(prefix))))


def _holds_halves(columns: Mapping[str, np.ndarray]) -> bool:
    """Whether these are half-precision floats, which PLY has no name for, so that exporters write ushort: log scales are no whole numbers."""
    sizes = [columns[name].dtype for name in (*SCALE, *QUATERNION) if name in columns]
    return bool(sizes) and all(dtype.kind == "u" and dtype.itemsize == 2 for dtype in sizes)


def _with_halves(columns: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
    if not _holds_halves(columns):
        return columns
    known = {*NEEDED, *rest_names(columns)}
    halves = {name for name, column in columns.items() if name in known and column.dtype.str[1:] == "u2"}
    return {name: column.view(f"{column.dtype.str[0]}f2") if name in halves else column for name, column in columns.items()}


def _with_dc(columns: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
    """The columns with f_dc computed from red, green and blue if it is missing: integers of full range, or floats in 0..1, or in 0..255, as
    MetalSplatter knows them of nerfstudio's older files."""
    if DC[0] in columns or not all(name in columns for name in RGB):
        return columns
    full = 255 if has_bright_colors(columns) else 1
    return {**columns, **{dc: (_unit(columns[name]) / full - 0.5) / C0 for dc, name in zip(DC, RGB, strict=True)}}


def has_bright_colors(columns: Mapping[str, np.ndarray]) -> bool:
    """Whether the colors, red, green and blue in place of harmonics, are floats in 0..255."""
    colors = [columns[name] for name in RGB if name in columns and DC[0] not in columns]
    return any((np.isfinite(each) & (each > BRIGHTEST)).any() for each in colors if each.dtype.kind == "f")


def _with_logits(columns: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
    """The columns with logits of opacities that are whole numbers of full range, as of point clouds: logits are none."""
    if not _whole_opacities(columns):
        return columns
    opacities = _unit(columns["opacity"]).clip(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    return {**columns, "opacity": np.log(opacities / (1 - opacities))}


def _whole_opacities(columns: Mapping[str, np.ndarray]) -> str:
    """The type of opacities that are whole numbers; "" if they are floats, or missing."""
    whole = "opacity" in columns and columns["opacity"].dtype.kind in "iu" and not _holds_halves(columns)
    return columns["opacity"].dtype.name if whole else ""


def _unit(column: np.ndarray) -> np.ndarray:
    full = np.iinfo(column.dtype).max if column.dtype.kind in "iu" else 1
    return column.astype(np.float64) / full


def stacked(columns: Mapping[str, np.ndarray], names: tuple[str, ...]) -> Tensor:
    """The columns `names` as [N, len(names)] float32. Values that overflow become infinite, and are reported by `health`."""
    block = np.empty((len(columns["x"]), len(names)), np.float32)
    with np.errstate(over="ignore"):
        for start in range(0, len(block), CHUNK):
            for i, name in enumerate(names):
                block[start : start + CHUNK, i] = columns[name][start : start + CHUNK]
    return torch.from_numpy(block)
