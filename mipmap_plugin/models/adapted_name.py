"""The name under which the model adapted to a scale is saved."""

from __future__ import annotations

import re
from pathlib import Path

from mipmap_plugin.errors import MipmapPluginError
from mipmap_plugin.formats.atomic import absolute, named
from mipmap_plugin.formats.readers import READ_GLB
from mipmap_plugin.formats.splat_transform import EXCHANGE, READ_ONLY, WRITTEN
from mipmap_plugin.models.detect import detect
from mipmap_plugin.models.families import BUILT_IN, find_family
from mipmap_plugin.models.family import Files
from mipmap_plugin.models.places import GSPLAT, SPLATFACTO, around
from mipmap_plugin.models.zipped_folder import unzipped

GLTF = (".glb", ".gltf")
COMPRESSED = EXCHANGE["compressed"][1]

# Families that are saved with torch, and the viewers of the same projects; for any other a PLY is written.
SAVED_WITH_TORCH = ("gsplat", "splatfacto")
OWN_VIEWERS = ("gsplat", "gsplat-antialiased", "nerfstudio", "nerfstudio-antialiased")


def adapted_name(checkpoint: Path, scale: float, viewer: str | None = None) -> str:
    """NAME_x0.25 or NAME_x0.25_spark, with the ending of what is saved; none for a folder. NAME is that of `name_of`.

    The ending is that of the file, but for these:
    - an exchange format that is only read, or has another ending, and a PLY in a zip archive: .ply;
    - glTF: .glb, or .ply for a viewer that does not read that;
    - a third-party family: the one that it names (`Family.saves`), or .ply for any viewer;
    - what gsplat and nerfstudio save: none, as it becomes a folder of theirs, or .ply for a viewer of others.
    """
    name = name_of(checkpoint)
    read, written = _endings(checkpoint, name, viewer)
    return f"{name[: len(name) - len(read)]}_x{scale:g}{f'_{viewer}' if viewer else ''}{written}"


def name_of(checkpoint: Path) -> str:
    """The name of a checkpoint among others: that of a link, not of what it leads to, and MODEL_iteration_7000 of one iteration of a model folder."""
    model = model_of(checkpoint)
    return f"{model.name}_{named(checkpoint).name}" if model else named(checkpoint).name


def model_of(checkpoint: Path) -> Path | None:
    """The model folder of one iteration: of a folder `point_cloud/iteration_<N>`, or the file of a step of gsplat or nerfstudio; None for any other
    path. 3DGS and nerfstudio do not find the newest where anything else lies in there (`searchForMaxIteration`, `eval_load_checkpoint`), so what is
    adapted from one does not.

    Links are not followed: the folder is the one that the path names, also where a part of it lies on another disk.
    """
    place = absolute(checkpoint) if ".." in checkpoint.parts else checkpoint.absolute()
    if checkpoint.is_dir():
        model, iteration = around(place / "point_cloud.ply")
        return None if iteration is None else model
    is_step = any(place.parent.name == folder and re.fullmatch(pattern, place.name) for folder, pattern in (GSPLAT, SPLATFACTO))
    return place.parent.parent if is_step else None


def _is_plain(checkpoint: Path) -> bool:
    """Whether a file is a PLY whose columns are not packed, whatever its name says."""
    try:
        files = Files(checkpoint)
        return files.header is not None and not files.compressed
    except MipmapPluginError:  # whoever loads it says so
        return False


def _endings(checkpoint: Path, name: str, viewer: str | None) -> tuple[str, str]:
    """The ending of a checkpoint's name, and that of the adapted file; "" for none."""
    if not checkpoint.is_file() and checkpoint.suffix != ".ply":
        return "", _of_folder(checkpoint, viewer)
    if name.lower().endswith(GLTF):
        return Path(name).suffix, ".glb" if viewer is None or viewer in READ_GLB else ".ply"
    if ending := next((known for known in (*WRITTEN, ".ply", *READ_ONLY) if name.lower().endswith(known)), ""):
        return ending, ".ply" if ending in READ_ONLY or (ending == COMPRESSED and _is_plain(checkpoint)) else ending
    try:
        family = find_family(detect(checkpoint).family)
    except MipmapPluginError:  # whoever loads it says so
        return "", ""
    if unzipped(checkpoint) != checkpoint:  # a folder in a zip archive
        return Path(name).suffix, _of_folder(checkpoint, viewer)
    if family in BUILT_IN:
        written = ".ply" if family.name in ("zipped", "gltf", "exchange") else _of_folder(checkpoint, viewer)
        return (Path(name).suffix, written) if written else ("", "")
    own = Path(name).suffix if family.saves is None else family.saves
    return Path(name).suffix, own if viewer is None else ".ply"


def _of_folder(checkpoint: Path, viewer: str | None) -> str:
    """The ending of what a checkpoint is saved as that otherwise becomes a folder: ".ply" where another project's viewer shows it, or ""."""
    if viewer is None or viewer in OWN_VIEWERS:
        return ""
    try:
        return ".ply" if detect(checkpoint).family in SAVED_WITH_TORCH else ""
    except MipmapPluginError:  # whoever loads it says so
        return ""
