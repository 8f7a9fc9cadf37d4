"""Checks before a model is saved: it must not replace the checkpoint that it was read from, and its numbers must be finite."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from mipmap_plugin.errors import OutputExists, SettingsError, plural, some_of
from mipmap_plugin.formats.atomic import absolute, named, refuse_output, refuse_to_lose
from mipmap_plugin.formats.magic import kind_of
from mipmap_plugin.formats.ply import read_header
from mipmap_plugin.formats.splat_transform import MOST_BANDS, TOOL, is_spz, refuse_ending, refuse_exchange, written_ending
from mipmap_plugin.formats.spz import fraction_for
from mipmap_plugin.formats.tags import provenance_of
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.columns import in_short
from mipmap_plugin.models.health import COARSE_SHARE, COARSE_STEP, extent_of, rows_where
from mipmap_plugin.models.places import CONVERTED, PARTS, REPORT, STATE, has_report

# What is written into a model folder, of all families.
WRITTEN = (
    "cfg_args", "cameras.json", "input.ply", "exposure.json", "cfg.yml", "config.yml", "dataparser_transforms.json", "ckpts/*.pt",
    "nerfstudio_models/*.ckpt", "deform/*/deform.pth", "point_cloud/*/point_cloud.ply", "point_cloud/*/*.pt", "point_cloud/*/*.pth", f"*{REPORT}",
)  # fmt: skip

# Bits of fractions of a unit that other writers of SPZ keep of all positions, and that a single splat 2,048 units away leaves (`formats.spz`).
USUAL_FRACTION = 12

# What SPZ stores: log scales, the size of the coefficients of degree 0 (whose color lies between -0.44 and 1.44), and that of all others.
SPZ_LOG_SCALES, SPZ_COLOR, SPZ_HARMONICS = (-10.0, 5.9375), 0.5 / 0.15, 1.0

# A length that is seen, as a fraction of the scene's: a quarter of a pixel, less than any filter's, where the scene is 1,000 pixels wide.
SEEN_LENGTH = 2.5e-4

# Finite numbers that in float32 activate as an infinite logit and logarithm do: to an opacity of 1 or 0, and a length of almost 0.
LOGIT, LOG_SCALE = 80.0, -87.0


def parts_of(source: Path | None, folder: Path | None) -> list[Path]:
    """The files of the checkpoint that was read from the file `source` in `folder`, as far as these are known.

    Outputs of adaptations in the same place, which have a report beside them, are not included.
    """
    around = [] if source is None or not source.absolute().parent.is_dir() else source.absolute().parent.iterdir()  # it may be gone
    files = [file for file in around if source is not None and _belongs(file.name, source.name)]
    if folder is not None and folder.is_dir():
        files += [*folder.iterdir(), *(file for part in PARTS for file in (folder / part).rglob("*"))]
    return [*([source] if source else []), *(file for file in files if file.is_file() and not is_adapted(file))]


def refuse_parts(path: Path, overwrite: bool, source: Path | None, folder: Path | None, holds: str | None) -> None:
    """Raise OutputExists for a path that a model of that checkpoint may not be saved to. `holds`: subfolder of model folders; None for a file.

    Raises SettingsError for a folder with the suffix of a file.
    """
    refuse_output(path, overwrite, parts_of(source, folder), is_file=holds is None)
    if holds is not None:
        refuse_ending(path)
        refuse_to_lose(path, source if folder is None else folder, holds, WRITTEN)
        place = absolute(path)
        if not is_adapted(place) and any(map(_is_of_a_training, place.glob("point_cloud/*/point_cloud.ply"))):
            raise OutputExists(f"{path} holds a trained model, which --overwrite would delete; choose another folder")


def _is_of_a_training(ply: Path) -> bool:
    """Whether a PLY has no provenance of this package."""
    return kind_of(ply) == "ply" and provenance_of(read_header(ply).comments) is None


def refuse_format(path: Path, trained: TrainedScale, parameters: Mapping[str, Tensor]) -> None:
    """Raise SettingsError for an exchange format at `path` if the splats need the screen filter of their training, or if it cannot be written, or has
    no place for their centers, or if there are none. `parameters`: raw."""
    if not len(parameters["means"]):
        raise SettingsError(f"{path}: there are no splats to write, which this format needs; give a .ply")
    if trained.keeps_filter:
        own = f"the filter of their own project ({trained.told()})"
        raise SettingsError(f"{path}: these splats need {own}; give a .ply or a folder, or adapt for a viewer if the family allows it")
    if written_ending(path) != ".glb":
        refuse_exchange(path)
    if is_spz(path):
        refuse_far(path, parameters, "give a .sog or a .ply")


def refuse_far(path: Path, parameters: Mapping[str, Tensor], instead: str) -> None:
    """Raise SettingsError for splats so far away that SPZ would round many positions by half of a size and more, or has no room for them.

    `parameters`: raw. `instead`: what else can be done.
    """
    farthest, sizes = parameters["means"].detach().abs().amax().item(), parameters["scales"].detach().amax(dim=1).exp()
    if not math.isfinite(farthest) or (fraction := fraction_for(farthest)) >= USUAL_FRACTION:  # of what is not finite `finite` tells
        return
    step = 2.0**-fraction
    coarse = int((step > COARSE_STEP * sizes).sum())
    if fraction < 0 or coarse > COARSE_SHARE * len(sizes):
        rounded = f"would round positions to {step:g} unit, more than half the size of {some_of(coarse, len(sizes), 'splat')}"
        where = f"a splat lies {farthest:,.0f} units from the origin along an axis, for which SPZ {'has no room' if fraction < 0 else rounded}"
        raise SettingsError(f"{path}: {where}; remove what lies far away, move or shrink the scene, or {instead}")


def without_place(path: Path, extras: Iterable[str], sh_degree: int) -> str:
    """What the file at `path` will not hold, in a sentence: columns that 3DGS does not define, high SH bands; "" if it holds everything."""
    if not (ending := written_ending(path)):
        return ""
    names = in_short(extras)
    lost = [f"the extra columns {names} are dropped, since {ending} has no place for them; a .ply has"] if names else []
    without = "glTF has no place for" if ending == ".glb" else f"{TOOL} does not write"
    lost += [f"SH bands above degree {MOST_BANDS} are dropped, which {without}; a .ply has them"] if sh_degree > MOST_BANDS else []
    return "; ".join(lost)


def cut_off(path: Path, parameters: Mapping[str, Tensor]) -> str:
    """How many of the splats with these raw `parameters` an SPZ at `path` cannot hold, even rounded, in a sentence; "" for any other format.

    Of thin splats only the longest axis counts: the others are lengthened by less than anybody sees. Nor do short splats count, of which a zoom-out
    makes many, unless the scene is so small that their lengthening is seen.
    """
    if not is_spz(path) or not {"means", "scales", "sh0", "shN"} <= parameters.keys():
        return ""
    longest, (least, most) = parameters["scales"].detach().amax(dim=1), SPZ_LOG_SCALES
    seen = math.exp(least) > SEEN_LENGTH * extent_of(parameters["means"].detach())
    colors, harmonics = (parameters[name].detach().abs().flatten(1) for name in ("sh0", "shN"))
    beyond = {
        f"longer than {math.exp(most):,.0f} units": longest > most,
        f"shorter than {math.exp(least):.2g} units": (longest < least) & seen,
        "with a color of degree 0 outside -0.44 to 1.44": (colors > SPZ_COLOR).any(dim=1),
        "with other harmonics outside -1 to 1": (harmonics > SPZ_HARMONICS).any(dim=1),
    }
    found = ", ".join(f"{int(where.sum()):,} {what}" for what, where in beyond.items() if where.any())
    return f"SPZ cuts off, of {plural(len(longest), 'splat')}, {found}; a .ply keeps them" if found else ""


def drawn_otherwise(path: Path, trained: TrainedScale) -> str:
    """That many viewers of the exchange format of `path` do not draw splats as they were trained, in a sentence; "" if they do, or of a .ply."""
    if trained.screen_filter == TrainedScale.screen_filter or not (ending := written_ending(path)):
        return ""
    right = f"the file is right where splats are drawn as in training ({trained.told()})"
    return f"{right}, which not all viewers of {ending} do; for others adapt for a viewer"


def finite(parameters: Mapping[str, Tensor], most: float) -> dict[str, Tensor]:
    """The raw parameters, with infinite logits and log scales of -infinity replaced by finite numbers that activate alike.

    Raises SettingsError if a row contains NaN, or is infinite or above `most` once activated.
    """
    cleaned = {name: tensor.detach() for name, tensor in parameters.items()}
    for name, low, high in (("opacities", -LOGIT, LOGIT), ("scales", LOG_SCALE, torch.inf)):
        if name in cleaned:
            cleaned[name] = cleaned[name].nan_to_num(nan=torch.nan, posinf=high, neginf=low)
    for name, value in {**cleaned, "lengths": cleaned["scales"].exp()}.items():
        if rows := rows_where(partial(_is_wrong, most=torch.inf if name in ("opacities", "quats") else most), value):
            raise SettingsError(
                f"{some_of(rows, len(value), 'row', 'hold')} a NaN, an infinity or more than {most:g} in {name}, so nothing is saved;"
                " adapt less boldly, or to another scale"
            )
    return cleaned


def _is_wrong(values: Tensor, most: float) -> Tensor:
    """Where values are NaN, infinite or above `most`."""
    return ~(values.isfinite() & (values.abs() <= most))


def _belongs(name: str, source: str) -> bool:
    """Whether a file beside `source` is read with it: another rank of a training, or a network of its splats."""
    rank = re.fullmatch(r"(ckpt_\d+_rank)\d+\.pt", source)
    return bool(rank and re.fullmatch(re.escape(rank[1]) + r"\d+\.pt", name)) or name.endswith((".pth", "_mlp.pt", "embedding_appearance.pt"))


def is_adapted(file: Path) -> bool:
    """Whether a file is the output of an adaptation, its report or the state of its run. Raises OutputError for a root."""
    file = named(file)
    return file.name.endswith((REPORT, STATE, STATE + CONVERTED)) or has_report(file)
