"""Streamed SOG through splat-transform: levels of a scene, cut into chunks, each level of a chunk being a part of a SOG file.

SOG looks up spherical harmonics in a table of up to 64 K entries, which k-means finds. On a processor splat-transform compares every splat with
nearly every entry, ten times: hours for a table of that size. So without a GPU files are small, each with a small table of its own, and one
iteration has to do: it begins from the splats' own values, and a table has at least half as many entries as splats.
"""

from __future__ import annotations

import re
import subprocess
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mipmap_plugin.errors import OutputError
from mipmap_plugin.formats.json_file import read_json
from mipmap_plugin.formats.splat_transform import TOOL, answer, reason_in, refuse_exchange
from mipmap_plugin.progress import told

# Thousands of splats in a file where there is no GPU: about 1 ms for each splat, at 4 as at 8; twice that at 16.
SMALL_FILE = 4

# Thousands of splats, of all levels, below which a chunk is not split for its extent.
SMALLEST_CHUNK = 1

# Adapters that splat-transform lists beside GPUs, and that are processors.
SOFTWARE = re.compile("llvmpipe|swiftshader|lavapipe|software|basic render", re.IGNORECASE)

# Its last lines that are kept to find out why it failed: an error, a trace and a summary.
LINES = 100

# A line of splat-transform when it begins a file.
BEGUN = re.compile(r"\[(\d+)/(\d+)\] (?:\d+_\d+|env)$")


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
    card = _graphics_card(tool)
    machine = ["--gpu", card] if card else ["--gpu", "cpu", "--sh-iterations", "1", "--lod-chunk-count", str(SMALL_FILE)]
    chunks = ["--lod-chunk-extent", str(extent), "--lod-chunk-min", str(SMALLEST_CHUNK)]
    inputs = [word for number, file in enumerate(levels) for word in (str(file), "--tag-lod", str(number))]
    command = [*tool, "--no-tty", "--overwrite", *machine, *chunks, *inputs, str(output)]
    if reason := _followed(command) or ("" if output.is_file() else "it wrote nothing"):
        raise OutputError(f"{output}: {TOOL} does not write it ({reason})")


def _graphics_card(tool: Sequence[str]) -> str:
    """The number of the first GPU that splat-transform lists; empty if there is none."""
    listed = answer([*tool, "--list-gpus"]) or ""
    return next((number for number, name in re.findall(r"^\[(\d+)\] (.*)$", listed, re.MULTILINE) if not SOFTWARE.search(name)), "")


def read_chunks(file: Path) -> list[Chunk]:
    """The chunks of a lod-meta.json. Raises SceneError if it is no JSON."""
    meta = read_json(file)
    return list(_leaves(meta["tree"], meta["lodLevels"]))


def _leaves(node: dict[str, Any], levels: int) -> Iterator[Chunk]:
    for child in node.get("children", ()):
        yield from _leaves(child, levels)
    if "lods" in node:
        splats = tuple(node["lods"].get(str(level), {"count": 0})["count"] for level in range(levels))
        yield Chunk(tuple(node["bound"]["min"]), tuple(node["bound"]["max"]), splats)


def _followed(command: Sequence[str]) -> str:
    """Run splat-transform, and show the files that it has written of as many as there are. Returns its error message, empty on success."""
    said = deque[str](maxlen=LINES)
    try:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, encoding="utf-8", errors="replace")
    except OSError as error:
        return str(error)[:160]
    with process, told("writing Streamed SOG", "file") as tell:
        try:
            for line in process.stderr or ():
                said.append(line)
                if begun := BEGUN.search(line.strip()):
                    tell(int(begun[1]) - 1, int(begun[2]))
        except BaseException:
            process.kill()
            raise
    return "" if process.returncode == 0 else reason_in("".join(said)) or f"exit code {process.returncode}"
