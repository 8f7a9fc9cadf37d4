"""What lies in a folder that is given: the checkpoints of families, model folders below it, or what people have in place of a checkpoint."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.models.families import FAMILIES, find_family
from mipmap_plugin.models.family import Family, Files
from mipmap_plugin.models.others import PHOTOGRAPHS
from mipmap_plugin.models.places import has_report

# Columns of plain point clouds and meshes, among which are the points that a training starts from: input.ply, points3D.ply, sparse_pc.ply.
OF_POINTS = frozenset(
    ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha", "s", "t", "u", "v", "flags", "quality", "confidence", "intensity")
)

# So many of the files are named that lie in the place of a PLY.
NAMED = 3

# A folder that is given too high is searched so deep, as nerfstudio's outputs/EXPERIMENT/METHOD/TIME are, and in so many folders.
DEPTH, MOST_LOOKED_AT = 3, 200


def checkpoints_in(folder: Path, *, below: bool = False) -> Iterator[tuple[Family, dict[int, Path]]]:
    """The families that have checkpoints in a result folder; `below`: in a subfolder. Families that fail are skipped here; `detect` reports them."""
    for name in FAMILIES.names():
        try:
            family = find_family(name)
            if family.place and (family.place[0] or not below) and (steps := _steps(folder, family, *family.place)):
                yield family, steps
        except CheckpointError:
            raise
        except Exception:  # third-party code may fail in any way
            continue


def _steps(folder: Path, family: Family, subfolder: str, pattern: str) -> dict[int, Path]:
    """The checkpoints of a family in its place in a result folder by step, 0 for a name without one; of several ranks the first."""
    place = folder / subfolder
    files = sorted(place.iterdir(), reverse=True) if place.is_dir() else []
    named = {int(name.groupdict().get("step") or 0): file for file in files if (name := re.fullmatch(pattern, file.name))}
    if subfolder:
        return named
    # Files of other projects may have such names, too.
    return {step: file for step, file in named.items() if family.recognize(Files(file))}


def splats_in(iteration: Path) -> Path:
    """The PLY in a folder iteration_<N>, which may not exist. Raises CheckpointError for a folder with files of another kind in its place."""
    ply = iteration / "point_cloud.ply"
    if ply.exists():
        return ply
    if (scene := iteration / "scene_point_cloud.ply").exists():
        raise CheckpointError(f"{iteration} is of SAGA; give the PLY of its scene itself: {scene}")
    if parts := sorted(iteration.glob("point_cloud_rk0_ws*.ply")):  # of Grendel-GS, which names the number of files even if it is 1
        return parts[0]
    others = [entry.name for entry in sorted(iteration.iterdir()) if entry.is_file()] if iteration.is_dir() else []
    if others:
        named = f"{', '.join(others[:NAMED])}{', ...' * (len(others) > NAMED)}"
        remedy = "make it with npz2ply.py, if c3dgs trained this" if f"{ply.stem}.npz" in others else "give a PLY of splats"
        raise CheckpointError(f"{iteration} has {named}, but no point_cloud.ply, which is what is read here; {remedy}")
    return ply


def holds_points(file: Path) -> bool:
    """Whether a PLY holds a plain point cloud or a mesh."""
    try:
        return frozenset() < Files(file).columns <= OF_POINTS
    except CheckpointError:
        return False


def meant_instead(folder: Path) -> str:
    """What people mean who give a folder without splats, in words: a folder below, or what a scene is trained on."""
    try:
        entries = sorted(folder.iterdir())
    except OSError:
        return ""
    meant = [entry for entry in entries if entry.is_dir() and any(entry.glob("*.ply"))]
    if meant:
        return f", but {', '.join(entry.name for entry in meant[:5])}{', ...' * (len(meant) > 5)}"
    if points := [entry.name for entry in entries if entry.suffix.lower() == ".ply"]:
        return f", but plain point clouds or meshes ({', '.join(points[:5])}{', ...' * (len(points) > 5)})"
    if any(entry.suffix.lower() in PHOTOGRAPHS or entry.name in ("images", "sparse") or entry.match("transforms*.json") for entry in entries):
        return ", but photographs or what a scene is trained on (that is for --images and --cameras)"
    return ""


def model_folders_below(folder: Path) -> list[Path]:
    """The model folders at most DEPTH levels below a folder, as far as they are found among MOST_LOOKED_AT folders; the newest names first.

    Without adaptations, where there is a base.
    """
    level, looked_at, found = [folder], 0, list[Path]()
    for _ in range(DEPTH):
        below = [each for parent in level for each in _folders_in(parent)][: MOST_LOOKED_AT - looked_at]
        looked_at += len(below)
        holding = [each for each in below if is_model_folder(each)]
        found += sorted(holding, reverse=True)
        level = [each for each in below if each not in holding]
    return [each for each in found if not _was_adapted(each)] or found


def _was_adapted(folder: Path) -> bool:
    """Whether a model folder has the report of an adaptation beside its checkpoint. One that lies beside a file adapted from it does not count."""
    of_families = (file for _, steps in checkpoints_in(folder, below=True) for file in steps.values())
    return any(map(has_report, chain(of_families, folder.glob("point_cloud/*/point_cloud.ply"))))


def is_model_folder(folder: Path) -> bool:
    """Whether a folder is a model folder."""
    return (folder / "point_cloud").is_dir() or any(checkpoints_in(folder, below=True))


def _folders_in(folder: Path) -> list[Path]:
    """The folders in a folder; none in one that cannot be read."""
    try:
        return sorted(each for each in folder.iterdir() if each.is_dir() and not each.is_symlink())
    except OSError:
        return []
