"""The names of the files that the command line writes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import count as count_from
from pathlib import Path
from typing import TYPE_CHECKING

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.atomic import absolute
from mipmap_plugin.formats.splat_transform import WRITTEN

if TYPE_CHECKING:
    from mipmap_plugin.camera import Camera

# What separates folders, and what Windows takes in no name.
REPLACED = str.maketrans(dict.fromkeys('/\\:*?"<>|', "_"))


def adapted_path(checkpoint: Path, output: Path | None, scale: float, viewer: str | None = None, *, several: bool) -> Path:
    """The path of an adapted model: beside the checkpoint, of an iteration beside its model folder, as NAME_x0.25 or NAME_x0.25_spark
    (`adapted_name`), or `output`; a folder for all if `several`. Raises SettingsError for a folder with the name of a file."""
    from mipmap_plugin.models.adapted_name import adapted_name, model_of

    name = adapted_name(checkpoint, scale, viewer)
    if output is None:
        return (model_of(checkpoint) or absolute(checkpoint)).parent / name
    return folder_of_several(output, (".ply", *WRITTEN)) / name if several else output


def folder_of_several(output: Path, endings: tuple[str, ...]) -> Path:
    """The folder `output`. Raises SettingsError where there is none and it has the ending of a file that it would hold."""
    if output.name.lower().endswith(endings) and not output.is_dir():
        raise SettingsError(f"{output}: several files are written there; give the path of a folder")
    return output


def picture_names(views: Sequence[Camera]) -> list[str]:
    """The name of a PNG file for each view that every system takes, unique and without a folder; views of the same name are numbered.

    Names that differ in capitals alone are the same to Windows and macOS.
    """
    names = [f"{view.split}_{view.name}".translate(REPLACED) for view in views]
    counts = Counter(name.casefold() for name in names)
    taken = set(counts)
    for i, name in enumerate(names):
        if counts[name.casefold()] > 1:
            names[i] = next(numbered for number in count_from(1) if (numbered := f"{name}_{number}").casefold() not in taken)
            taken.add(names[i].casefold())
    return [f"{name}.png" for name in names]
