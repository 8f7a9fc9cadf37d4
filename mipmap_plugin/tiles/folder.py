"""The files of the work folder, until the whole is written."""

from __future__ import annotations

from pathlib import Path

from mipmap_plugin.formats.atomic import named
from mipmap_plugin.models.places import TILES

# What all jobs need of the scene; the base's splats; what the start is called, and its PSNR.
CUT, BASE, START = "cut.pt", "base.splats", "start.pt"

# A scene that is not cut needs no tiles.
FEWEST = 2


def work_folder(target: Path) -> Path:
    """Where the parts of a scene lie until it is whole, beside its file."""
    target = named(target)
    return target.with_name(target.name + TILES)


def truth_file(folder: Path, part: int) -> Path:
    """The truths of the `part`-th views."""
    return folder / f"truth_{part}.pictures"


def start_file(folder: Path, number: int) -> Path:
    """The splats that a tile begins with."""
    return folder / f"start_{number}.splats"


def layer_file(folder: Path, number: int, sweep: int) -> Path:
    """The pictures of a tile alone, as a sweep begins."""
    return folder / f"layer_{sweep}_{number}.pictures"


def halo_file(folder: Path, part: int, sweep: int) -> Path:
    """The `part`-th views as a sweep begins: the whole, and what each tile has around it."""
    return folder / f"halo_{sweep}_{part}.pictures"


def tile_file(folder: Path, number: int, sweep: int, step: int) -> Path:
    """The splats of a tile after a step of a sweep."""
    return folder / f"tile_{sweep}_{step}_{number}.splats"


def run_file(folder: Path, number: int, sweep: int) -> Path:
    """What the next sweep of a tile goes on with; it is there when the tile has made the sweep's steps."""
    return folder / f"run_{sweep}_{number}.pt"


def steered_file(folder: Path, sweep: int) -> Path:
    """What became of a sweep."""
    return folder / f"steered_{sweep}.json"


def part_file(folder: Path, number: int) -> Path:
    """The splats of a tile as they stand in the whole file."""
    return folder / f"part_{number}.ply"
