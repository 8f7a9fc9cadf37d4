"""Detection of a checkpoint's family: every family may claim it, and the most certain claim wins."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

from mipmap_plugin.errors import CheckpointError, MipmapPluginError, PluginError, plural, type_of, with_type
from mipmap_plugin.formats.atomic import settled
from mipmap_plugin.limits import path_of
from mipmap_plugin.models.families import BUILT_IN, FAMILIES, find_family, not_loaded
from mipmap_plugin.models.family import OF_SPLATS, Family, Files, Match
from mipmap_plugin.models.folders import checkpoints_in, holds_points, is_model_folder, meant_instead, model_folders_below, splats_in
from mipmap_plugin.models.others import OTHERS, UNREAD
from mipmap_plugin.models.places import PARTS, has_report
from mipmap_plugin.models.zipped_folder import retold, unzipped, with_archives_named

# Suffixes of files of splats besides PLY.
EXCHANGED = (".spz", ".sog", ".splat", ".ksplat", ".glb", ".gltf")
OWN_SUFFIXES = (".ply", ".pt", ".ckpt", *EXCHANGED)

# The families of this package.
OWN = frozenset(family.name for family in BUILT_IN)

# So many of the model folders below a folder are named.
NAMED = 3


@dataclass(frozen=True)
class Checkpoint:
    """A detected checkpoint."""

    family: str  # a name in `families.FAMILIES`
    path: Path  # the file that holds the splats
    folder: Path | None = None  # the model folder around it
    iteration: int | None = None
    notes: tuple[str, ...] = ()  # iterations that were skipped, and why, in sentences


def detect(path: str | Path, *, iteration: int | None = None) -> Checkpoint:
    """Find the splats at `path`, a file, a model folder or a zip archive of one, and their family.

    In a folder, the newest `iteration_<N>` whose PLY is complete is used, or `iteration`.
    Raises CheckpointError for a path that is missing, damaged, or not a checkpoint.
    """
    if isinstance(path, str) and not path:
        raise CheckpointError("no path was given; give a PLY file or a model folder")
    path = settled(path_of(path))
    if path.is_dir():
        return _detect_folder(path, iteration)
    if (folder := unzipped(path)) != path:
        with retold(with_archives_named):
            return _detect_folder(folder, iteration)
    if iteration is not None and path.exists():
        raise CheckpointError(f"{path} is a file and has no iterations; give its model folder to choose iteration {iteration}")
    return _recognize(path)[0]


def detect_as(path: str | Path, families: tuple[str, ...], *, iteration: int | None) -> Checkpoint:
    """As `detect`, but raises CheckpointError for any family not in `families`."""
    checkpoint = detect(path, iteration=iteration)
    if checkpoint.family in families:
        return checkpoint
    family = find_family(checkpoint.family)
    if family.load is None:
        raise CheckpointError(f"{checkpoint.path}: {not_loaded(checkpoint.family)}")
    raise CheckpointError(f"{checkpoint.path} is a checkpoint of {family.title}, which is read in another way; load it with load_model")


def _recognize(path: Path) -> tuple[Checkpoint, Match]:
    if not path.exists():
        leads = f"is a link to {path.readlink()}, which " if path.is_symlink() else ""  # as in a cache, whose download was removed
        raise CheckpointError(f"{path} {leads}does not exist; give a PLY file or a model folder")
    files = Files(path)
    claims, notes = _claims(files)
    family, match = _most_certain(files, claims, notes)
    if match.trouble:
        raise CheckpointError(match.trouble)
    if files.header and not files.header.vertex.count:
        raise CheckpointError(f"{path} holds no splats: its header declares none; export it again")
    return Checkpoint(family.name, path, files.folder, files.iteration, tuple(notes)), match


def _claims(files: Files) -> tuple[dict[str, tuple[Family, Match]], list[str]]:
    """The families that claim a file, and notes on families that fail, which must not break the others."""
    claims, notes = {}, []
    for name in FAMILIES.names():
        try:
            family = find_family(name)
            match = family.recognize(files)
            if not isinstance(match, Match | None):
                raise PluginError(f"its recognize returns {type_of(match)}; it has to be a Match or None")
            if match is not None:
                claims[name] = family, match
        except (Exception, SystemExit) as error:  # third-party code may fail in any way
            if name in OWN and isinstance(error, CheckpointError):
                raise  # what is wrong with the file
            notes.append(f"the family {name!r} failed: {error if isinstance(error, MipmapPluginError) else with_type(error)}")
    return claims, notes


def _most_certain(files: Files, claims: dict[str, tuple[Family, Match]], notes: list[str]) -> tuple[Family, Match]:
    """The most certain claim over which no other takes precedence."""
    passed_over = {name for family, _ in claims.values() for name in family.before}
    left = [claim for name, claim in claims.items() if name not in passed_over]
    best = [(family, match) for family, match in left if match.sure == max(match.sure for _, match in left)]
    if claims and not left:
        names = ", ".join(map(repr, claims))
        raise CheckpointError(f"{files.path} is claimed by {names}, each of which another comes before; one has to let go of its `before`")
    if not best:
        raise CheckpointError("; ".join([_why_not(files), *notes]))
    if len(best) > 1:
        claimants = " and ".join(f"{family.name!r} ({match.why})" for family, match in best)
        raise CheckpointError(f"{files.path} is claimed by {claimants}; one of these families has to name the other in its `before`")
    return best[0]


def _why_not(files: Files) -> str:
    path, kind = files.path, files.kind
    if path.suffix.lower() not in OWN_SUFFIXES and has_report(path):
        remedy = "install the package that adds that family (`mipmap-plugin list families` shows which are found), or give the file its ending again"
        return f"{path} was adapted from a checkpoint of a family that is not installed here, or knows its files by another ending; {remedy}"
    if files.header:
        if len(missing := OF_SPLATS - files.columns) < len(OF_SPLATS) / 2 or "f_dc_0" in files.columns:
            return f"{path} is no whole 3DGS checkpoint: it lacks the columns {', '.join(sorted(missing))}; export it again with them"
        columns = ", ".join(files.header.vertex.names[:8])
        return f"{path} is a plain point cloud or a mesh (columns {columns}), not Gaussian splats; give a trained model"
    if kind == "torch" and re.fullmatch(r"chkpnt\w*\.pth", path.name):
        return f"{path} is the state of a training, which 3DGS resumes from and which is not read here; give the model folder that it lies in"
    if kind == "torch":
        return f"{path} is a torch file that holds no known checkpoint; give a PLY file or a model folder"
    if kind == "unknown" and path.suffix.lower() in (".ply", *EXCHANGED):
        return f"{path} is damaged, cut off or no {path.suffix.lower()} file; download or export it again"
    if path.suffix.lower() in (".lcc", ".lcc2"):
        return f"{path} is LCC of XGRIDS, which is not read here; convert it: splat-transform {path.name} {path.stem}.ply"
    if other := OTHERS.get(path.suffix.lower()):
        return f"{path} is {other}"
    if kind == "3d-tiles":
        return f"{path} is the tileset of 3D Tiles; give one of its tiles (.glb)"
    if kind == "unknown" and is_model_folder(path.parent):  # as nerfstudio's commands take the config.yml
        return f"{path} is one file of a model folder; give the folder, {path.parent}"
    if path.match("*transforms*.json") or path.name == "cameras.json":
        return f"{path} holds cameras, not splats; give the checkpoint, and this file by --cameras (cameras=)"
    return {
        "torchscript": f"{path} is a TorchScript network, one companion of an anchor model; give the model folder that holds its point_cloud.ply",
        "zip": f"{path} is a zip archive; unpack it and give the PLY or the folder in it",
        "gzip": f"{path} is a gzip file; unpack it first",
    }.get(kind, f"{path} is no checkpoint that is known here; give a PLY, .spz, .sog, .splat or .glb, or a model folder")


def _detect_folder(folder: Path, iteration: int | None) -> Checkpoint:
    if (folder / "point_cloud").is_dir():
        return _detect_iteration(folder, iteration)
    if placed := next(checkpoints_in(folder), None):
        return _detect_step(*placed, folder, iteration)
    if iteration is not None:
        raise CheckpointError(f"{folder} has no point_cloud/iteration_{iteration}; give the model folder above it, or no iteration")
    files = sorted(folder.iterdir())
    clouds = [file for file in files if file.suffix.lower() == ".ply" and not holds_points(file)]
    for endings in (EXCHANGED, UNREAD):
        clouds = clouds or [file for file in files if file.suffix.lower() in endings and file.is_file()]
    clouds = [cloud for cloud in clouds if not has_report(cloud)] or clouds  # no adaptations, where there is a base
    if len(clouds) > 1 and folder / "point_cloud.ply" in clouds:
        clouds = [folder / "point_cloud.ply"]
    if len(clouds) == 1:
        return detect(clouds[0])
    if not clouds and folder.name in PARTS and is_model_folder(folder.parent):
        raise CheckpointError(f"{folder} is one part of a model folder; give the folder, {folder.parent}")
    some = ", ".join([*(cloud.name for cloud in clouds[:5]), *["..."] * (len(clouds) > 5)])
    if not clouds and (below := model_folders_below(folder)):
        more = ", ..." if len(below) > NAMED else ""
        raise CheckpointError(f"{folder} lies above its checkpoint{'s' * (len(below) > 1)}; give {' or '.join(map(str, below[:NAMED]))}{more}")
    content = f"{plural(len(clouds), 'file')} of splats ({some})" if clouds else f"no point_cloud folder and no file of splats{meant_instead(folder)}"
    raise CheckpointError(f"{folder} holds {content}; give one file, or a model folder with point_cloud/iteration_<N>")


def _detect_iteration(folder: Path, wanted: int | None) -> Checkpoint:
    """The newest complete iteration, or the `wanted` one, with notes on those that were skipped."""
    entries = {int(m[1]): entry for entry in (folder / "point_cloud").iterdir() if (m := re.fullmatch(r"iteration_(\d+)", entry.name))}
    if not entries:
        raise CheckpointError(f"{folder / 'point_cloud'} holds no iteration_<N> folder; give the PLY file itself")
    if wanted is not None and wanted not in entries:
        raise CheckpointError(f"{folder / 'point_cloud'} has no iteration_{wanted}; it has {', '.join(map(str, sorted(entries)))}")
    troubles: list[str] = []
    for number in [wanted] if wanted is not None else sorted(entries, reverse=True):
        try:
            ply = splats_in(entries[number])
            checkpoint, match = _recognize(settled(ply))
            if match.lacks:
                raise CheckpointError(f"{entries[number]} is an incomplete checkpoint, without {', '.join(match.lacks)}")
            skipped = tuple(f"iteration_{number} is used, since {trouble}" for trouble in troubles)
            return Checkpoint(checkpoint.family, ply, folder, number, (*checkpoint.notes, *skipped))
        except CheckpointError as error:
            troubles.append(str(error))
    raise CheckpointError(f"{folder} has no whole checkpoint: {'; '.join(troubles)}")


def _detect_step(family: Family, steps: dict[int, Path], folder: Path, wanted: int | None) -> Checkpoint:
    step = max(steps) if wanted is None else wanted
    if step not in steps:
        raise CheckpointError(f"{folder} has no checkpoint of step {step}; it has {', '.join(map(str, sorted(steps)))}")
    checkpoint = detect(steps[step])  # other families may use the same place
    return replace(checkpoint, folder=folder, iteration=step) if family.place and family.place[0] else checkpoint
