"""The name under which the model adapted to a scale is saved."""

from __future__ import annotations

from pathlib import Path

from mipmap_plugin.errors import MipmapPluginError
from mipmap_plugin.formats.splat_transform import EXCHANGE, READ_ONLY, WRITTEN
from mipmap_plugin.models.detect import detect
from mipmap_plugin.models.families import BUILT_IN, find_family
from mipmap_plugin.models.family import Files
from mipmap_plugin.models.zipped_folder import opened

COMPRESSED = EXCHANGE["compressed"][1]


def adapted_name(checkpoint: Path, scale: float, viewer: str | None = None) -> str:
    """NAME_x0.25 or NAME_x0.25_spark, with the ending of what is saved; none for a folder.

    Exchange formats that can only be read are written as a PLY, as are glTF and a PLY in a zip archive, and files of third-party families
    as these say (`Family.saves`), but for a viewer as a PLY. Files that other projects save with torch become a folder, as those of INRIA are.
    """
    name = checkpoint.resolve().name
    read, written = _endings(checkpoint, name, for_viewer=viewer is not None)
    return f"{name[: len(name) - len(read)]}_x{scale:g}{f'_{viewer}' if viewer else ''}{written}"


def _is_plain(checkpoint: Path) -> bool:
    """Whether a file is a PLY whose columns are not packed, whatever its name says."""
    try:
        files = Files(checkpoint)
        return files.header is not None and not files.compressed
    except MipmapPluginError:  # whoever loads it says so
        return False


def _endings(checkpoint: Path, name: str, *, for_viewer: bool) -> tuple[str, str]:
    """The ending of a checkpoint's name, and that of the adapted file; "" for none."""
    if not checkpoint.is_file() and checkpoint.suffix != ".ply":
        return "", ""
    if ending := next((known for known in (*WRITTEN, ".ply", *READ_ONLY) if name.lower().endswith(known)), ""):
        return ending, ".ply" if ending in READ_ONLY or (ending == COMPRESSED and _is_plain(checkpoint)) else ending
    try:
        family = find_family(detect(checkpoint).family)
    except MipmapPluginError:  # whoever loads it says so
        return "", ""
    if opened(checkpoint) != checkpoint:  # a folder in a zip archive
        return Path(name).suffix, ""
    if family in BUILT_IN:
        return (Path(name).suffix, ".ply") if family.name in ("zipped", "gltf") else ("", "")
    own = Path(name).suffix if family.saves is None else family.saves
    return Path(name).suffix, ".ply" if for_viewer else own
