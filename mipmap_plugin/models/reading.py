"""Splats read from a PLY of 3DGS, or of a family with the same columns, with what its header and its model folder say, and without invalid ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from mipmap_plugin.errors import CheckpointError, some_of, warn
from mipmap_plugin.formats.atomic import sha256
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.tags import recorded_filter, render_mode
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.columns import FILTER_3D, extra_columns, notes_on, notes_on_types
from mipmap_plugin.models.detect import Checkpoint, detect_as
from mipmap_plugin.models.exposure import read_exposures
from mipmap_plugin.models.health import dropped, examine, refuse_few, why_invalid
from mipmap_plugin.models.inria_folder import companion_notes, read_options, trained_scale
from mipmap_plugin.models.vanilla import Model, Origin, VanillaModel

# A fused file of Mip-Splatting has the columns of 3DGS; only its usual name tells it apart.
FUSED = "its name says that a 3D filter is fused into it; if Mip-Splatting trained it, say so (--screen-filter mip)"

# Of a file with more rows of zeros than this fraction a part is missing: a download, or a copy, has not ended. Drawn, such a row is a gray ball of
# size 1 at the origin, and no training writes one, for the quaternion of a splat has a length.
MOST_BLANK = 0.01

# Why the others are left out.
BLANK = "they hold nothing but zeros"


def load_vanilla(path: str | Path, *, iteration: int | None = None) -> VanillaModel:
    """Load a 3DGS PLY or model folder. Splats that are not finite once activated are dropped, with a note.

    Raises CheckpointError for a path that is damaged, of another family, or not a checkpoint.
    """
    return read_splats(detect_as(path, ("3dgs",), iteration=iteration), VanillaModel)


def read_splats(checkpoint: Checkpoint, kind: type[Model], *networks: Path) -> Model:
    """The splats of a checkpoint of 3DGS, or of a family that keeps them in the same columns, as a model of class `kind`. Raises CheckpointError.

    `networks`: further files of the checkpoint, which count in its digest.
    """
    path, folder = checkpoint.path, checkpoint.folder
    ply = read_ply(path)
    parameters, extras = kind.parameters_of(ply.columns, path), extra_columns(ply.columns)
    options, notes = read_options(folder)
    trained = trained_scale(options, ply.comments)
    screen_filter = trained.screen_filter if recorded_filter(ply.comments) else render_mode(ply.comments)
    origin = Origin(path, sha256(path, *networks), folder, checkpoint.iteration, ply.comments, extras, read_exposures(folder))
    model = kind(parameters, trained, origin, [*checkpoint.notes, *ply.notes, *notes, *notes_on_types(ply.columns)])
    del ply  # as large as the model, and no longer needed
    has_filter = FILTER_3D in extras  # whose family knows its screen filter
    taken_as_classic = screen_filter is None and trained.screen_filter == "classic" and not has_filter
    model.notes += companion_notes(options, model.sh_degree, model.traits.exposures, taken_as_classic)
    if screen_filter not in (None, "2dgs") and not has_filter:  # flat splats have a note of their own
        model.notes.append(f"the header says that the splats are to be drawn {trained.screen_filter} ({trained.eps2d:g} px²)")
    model.notes += notes_on(extras)
    model.notes += [FUSED] if "fused" in path.stem and taken_as_classic else []
    return without_invalid(_without_blank(model, path))


def _without_blank(model: Model, path: Path) -> Model:
    """The model without rows of zeros, with a note. Raises CheckpointError if there are many (`refuse_blank`)."""
    blank = blank_rows(model.parameters())
    refuse_blank(blank, path)
    return drop(model, blank, BLANK, path) if blank.any() else model


def blank_rows(parameters: Mapping[str, Tensor]) -> Tensor:
    """Which rows of a file, of whose columns these raw parameters are, hold nothing but zeros, [N] bool."""
    raw = [tensor.detach().flatten(1) if tensor.dim() > 1 else tensor.detach()[:, None] for tensor in parameters.values()]
    blank = (parameters["quats"].detach() == 0).all(1)
    blank[blank.clone()] = torch.stack([(tensor[blank] == 0).all(1) for tensor in raw]).all(0)
    return blank


def refuse_blank(blank: Tensor, path: Path) -> None:
    """Raise CheckpointError if more rows than MOST_BLANK are `blank` [N]."""
    count = int(blank.sum())
    if count > MOST_BLANK * len(blank):
        missing = f"{some_of(count, len(blank), 'row', 'hold')} nothing but zeros"
        raise CheckpointError(f"{path} is not whole: {missing}, as where a download or a copy has not ended; download or copy it again")


def without_invalid(model: Model) -> Model:
    """The model without splats that are not finite once activated, with a note. Raises CheckpointError if none or few are left (`refuse_few`),
    and for a file without any.

    Once for each model it warns of what is doubtful (`Health.doubts`), such as positions that float32 does not hold: a file of doubles loses them
    only here.
    """
    health = examine(model)
    if model.source is not None and not health.splats:
        raise CheckpointError(f"{model.source} holds no splats; export it again")
    refuse_few(health.invalid, model.source)
    for doubt in health.doubts():
        if doubt not in model.notes:
            warn(f"{model.source or 'this model'}: {doubt}")
            model = model.noted(doubt)
    if not health.invalid.any():
        return model
    return drop(model, health.invalid, "; ".join(why_invalid(model, health.invalid)), model.source)


def drop(model: Model, mask: Tensor, why: str, source: Path | str | None) -> Model:
    """A new model without the rows where `mask` [N] is True, with a note and a warning of their number. `source`: where they come from."""
    return model.keep_rows(~mask).noted(dropped(mask, "splat", why, source))


def as_tagged(trained: TrainedScale, comments: Sequence[str]) -> TrainedScale:
    """`trained` with the screen filter that the comments of an adapted file of another project name (`tags.with_tags`), if they name one."""
    name, eps2d = recorded_filter(comments) or (render_mode(comments) or trained.screen_filter, trained.eps2d)
    return replace(trained, screen_filter=name, eps2d=eps2d)
