"""The names of the files that the command line writes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mipmap_plugin.formats.splat_transform import READ_ONLY, WRITTEN

if TYPE_CHECKING:
    from mipmap_plugin.camera import Camera


def adapted_path(checkpoint: Path, output: Path | None, scale: float, viewer: str | None = None, *, several: bool) -> Path:
    """The path of an adapted model: beside the checkpoint as NAME_x0.25 or NAME_x0.25_spark, or `output`; a folder for all if `several`.

    Exchange formats that can only be read are written as a PLY.
    """
    checkpoint_name = checkpoint.resolve().name
    known = (*WRITTEN, ".ply", *READ_ONLY) if checkpoint.is_file() or checkpoint.suffix == ".ply" else ()
    suffix = next((ending for ending in known if checkpoint_name.lower().endswith(ending)), "")
    written = ".ply" if suffix in READ_ONLY else suffix
    name = f"{checkpoint_name[: len(checkpoint_name) - len(suffix)]}_x{scale:g}{f'_{viewer}' if viewer else ''}{written}"
    if output is None:
        return checkpoint.resolve().parent / name
    return output / name if several else output


def picture_names(views: Sequence[Camera]) -> list[str]:
    """The name of a PNG file for each view, unique and without a folder; views of the same name are numbered."""
    names = [f"{view.split}_{view.name}".replace("/", "_").replace("\\", "_") for view in views]
    numbers = [f"_{names[:i].count(name) + 1}" if names.count(name) > 1 else "" for i, name in enumerate(names)]
    return [f"{name}{number}.png" for name, number in zip(names, numbers, strict=True)]
