"""Streamed SOG through splat-transform: levels of a scene, cut into chunks, each level of a chunk being a part of a SOG file.

splat-transform cuts the scene and writes all files. Of these the SOGs are then written again by `formats.sog`, which rounds less, and needs no search
of minutes for a table of spherical harmonics. Which splats are in a file, and in which order, is read from their opacities: in place of these it was
given the numbers of the splats' rows, a digit at a time, which takes a run for each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from mipmap_plugin.errors import TEMPORARY, OutputError
from mipmap_plugin.formats.images import read_rgba
from mipmap_plugin.formats.json_file import read_json
from mipmap_plugin.formats.ply import read_header, read_ply, write_ply
from mipmap_plugin.formats.sog import rewrite_sog
from mipmap_plugin.formats.splat_transform import INSTALL, TOOL, refuse_exchange, run_tool
from mipmap_plugin.progress import announced, told

# Thousands of splats in a file, of which some get twice as many: there is then room in the table of harmonics for an entry of each splat.
IN_A_FILE = 32

# Thousands of splats, of all levels, below which a chunk is not split for its extent.
SMALLEST_CHUNK = 1

# The base of the digits: the levels of opacity of a SOG, without 255, so that its image is never opaque, and keeps its alpha channel.
DIGITS = 255

# A version of splat-transform that does what is expected here.
KNOWN = "3.7"

# Where the opacity of a digit lies between two levels: nearer to the lower one, so that it does not matter whether a version rounds, or rounds down.
WITHIN = 0.25


@dataclass(frozen=True)
class Chunk:
    """The box of a chunk, with all its levels, and the splats of each level."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    splats: tuple[int, ...]


def write_streamed_sog(levels: Sequence[Path], output: Path, extent: int) -> None:
    """Write `output`, a lod-meta.json, and its files beside it, from PLYs, the finest first; a terminal shows how far it is.

    `extent`: chunks larger than this, in world units, are split. Raises SettingsError without splat-transform, OutputError.
    """
    tool = refuse_exchange(output)
    most = max(read_header(level).vertex.count for level in levels)
    with TemporaryDirectory(prefix=TEMPORARY) as folder:
        cuts: list[Path] = []  # a lod-meta.json for each digit
        with announced("cutting the levels into chunks"):
            while not cuts or DIGITS ** len(cuts) < most:
                made = Path(folder, str(len(cuts)), output.name) if cuts else output
                if reason := _cut(tool, levels, made, extent, len(cuts)):
                    raise OutputError(f"{output}: {TOOL} does not write it ({reason})")
                cuts.append(made)
        with told("writing Streamed SOG", "file") as tell:
            _rewrite(levels, cuts, tell)


def _cut(tool: Sequence[str], levels: Sequence[Path], made: Path, extent: int, place: int) -> str:
    """Have splat-transform write Streamed SOG of levels whose opacities are the digits at a place. Returns its error message."""
    words = ["--lod-chunk-count", str(IN_A_FILE), "--lod-chunk-extent", str(extent), "--lod-chunk-min", str(SMALLEST_CHUNK)]
    made.parent.mkdir(exist_ok=True)
    with TemporaryDirectory(prefix=TEMPORARY) as folder:
        for number, level in enumerate(levels):
            copy, ply = Path(folder, f"{number}.ply"), read_ply(level)
            write_ply(copy, _numbered(ply.columns, place), ply.comments)
            words += [str(copy), "--tag-lod", str(number)]
        return run_tool(tool, words, made)


def _numbered(columns: Mapping[str, np.ndarray], place: int) -> dict[str, np.ndarray]:
    """The columns of splats whose opacities are the digits of their rows at a place.

    Of the others those are kept that the first lod-meta.json depends on, which has the boxes: numbers that are all equal need no search for codes.
    """
    equal = [*(f"f_dc_{channel}" for channel in range(3)), *(f"scale_{axis}" for axis in range(3) if place)]
    kept = {name: column for name, column in columns.items() if not name.startswith("f_") and name not in equal}
    rows = np.arange(len(columns["opacity"]))
    opacities = (rows // DIGITS**place % DIGITS + WITHIN) / DIGITS
    logits = np.log(opacities / (1 - opacities)).astype(np.float32)
    return kept | {name: np.zeros(len(rows), np.float32) for name in equal} | {"opacity": logits}


def _rewrite(levels: Sequence[Path], cuts: Sequence[Path], tell: Callable[[int, int], None]) -> None:
    """Write the SOGs beside the first of the `cuts` again, from the splats that they hold. Raises OutputError where these are not the levels'."""
    meta, done = read_json(cuts[0]), 0
    for number, level in enumerate(levels):
        columns, rows = read_ply(level).columns, _rows_by_file(meta, number, cuts)
        if not np.array_equal(np.sort(np.concatenate([np.zeros(0, np.int64), *rows.values()])), np.arange(len(columns["x"]))):
            raise OutputError(f"{cuts[0]}: {TOOL} did not write each splat of {level.name} once; run: {INSTALL}@{KNOWN}")
        for name, own in rows.items():
            rewrite_sog(cuts[0].parent / name, {key: column[own] for key, column in columns.items()})
            tell(done := done + 1, len(meta["filenames"]))


def _rows_by_file(meta: dict[str, Any], number: int, cuts: Sequence[Path]) -> dict[str, np.ndarray]:
    """The rows of a level's splats in each of its SOGs, by the names of these; none where a version of splat-transform writes something unknown."""
    try:
        files = {leaf["lods"][str(number)]["file"] for leaf in _leaves(meta["tree"]) if str(number) in leaf["lods"]}
        return {name: _rows([cut.parent / name for cut in cuts]) for name in (meta["filenames"][file] for file in sorted(files))}
    except (LookupError, TypeError, ValueError, AttributeError):  # other keys, other kinds of files, or not the same splats for each digit
        return {}


def _rows(metas: Sequence[Path]) -> np.ndarray:
    """The rows of the splats of a SOG, in its order, by its meta.json for each digit."""
    rows: np.ndarray = sum((_digits(meta) * DIGITS**place for place, meta in enumerate(metas)), np.zeros(1, np.int64))
    return rows


def _digits(meta: Path) -> np.ndarray:
    about = read_json(meta)
    return read_rgba(meta.with_name(about["sh0"]["files"][0]))[..., 3].ravel()[: about["count"]].astype(np.int64)


def read_chunks(file: Path) -> list[Chunk]:
    """The chunks of a lod-meta.json. Raises SceneError if it is no JSON."""
    meta = read_json(file)
    return [_chunk(leaf, meta["lodLevels"]) for leaf in _leaves(meta["tree"])]


def _chunk(leaf: dict[str, Any], levels: int) -> Chunk:
    splats = tuple(leaf["lods"].get(str(level), {"count": 0})["count"] for level in range(levels))
    return Chunk(tuple(leaf["bound"]["min"]), tuple(leaf["bound"]["max"]), splats)


def _leaves(node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for child in node.get("children", ()):
        yield from _leaves(child)
    if "lods" in node:
        yield node
