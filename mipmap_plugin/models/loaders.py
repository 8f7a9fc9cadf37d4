"""What the loader of the viewer that a PLY is made for reads of it: SH bands, extra columns, and Mip-Splatting's column filter_3D."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mipmap_plugin.formats.splat_transform import is_written
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.models.columns import FILTER_3D
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.splatting.viewers import degree_for, find_viewer, reads_extra_columns, viewers_for


def for_loader_of(viewer: str | None, model: SplatModel, path: Path) -> SplatModel:
    """The model as the viewer that it is made for loads it from `path`.

    Mip-Splatting's loader requires the column filter_3D. It is 0: the splats of a file for a viewer are smoothed as far as they have to be. Other
    loaders read PLYs of some SH degrees only (`Viewer.read_degrees`), or without further columns.
    """
    if is_written(path) or not isinstance(model, VanillaModel):
        return model
    degree = degree_for(viewer, model.sh_degree)
    if degree != model.sh_degree and (path.suffix.lower() == ".ply" or not model.traits.placed):
        model = model.with_degree(degree)
    if model.extras and not reads_extra_columns(viewer):
        model = model.with_extras({})
    return model.with_extras({**model.extras, FILTER_3D: np.zeros(len(model), dtype=np.float32)}) if wants_filter(viewer) else model


def unread(viewer: str | None, model: SplatModel, path: Path) -> str:
    """What the file at `path` is without, for the loader of the viewer does not read it, in a sentence; "" if it has everything."""
    written = for_loader_of(viewer, model, path)
    degree, read = (getattr(each, "sh_degree", 0) for each in (model, written))
    extras = ", ".join(name for name in getattr(model, "extras", ()) if name not in getattr(written, "extras", ()))
    lost = ([f"SH bands above degree {read}"] if read < degree else []) + ([f"the extra columns {extras}"] if extras else [])
    return f"{' and '.join(lost)} are left out, which loaders of {viewer} do not read right" if lost else ""


def wants_filter(viewer: str | None) -> bool:
    """Whether the viewer, or each of a group, reads the column filter_3D."""
    return viewer is not None and all(find_viewer(name).filter_3d for name in viewers_for(viewer))
