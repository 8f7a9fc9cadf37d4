"""The model folder of 3DGS around a PLY: reading its companion files, and writing a new folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeGuard

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.atomic import new_folder
from mipmap_plugin.formats.cfg_args import ENCODING, cfg_args_text, format_cfg_args, read_cfg_args_and_rest
from mipmap_plugin.formats.tags import recorded_filter, render_mode
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.exposure import NO_EXPOSURES, Exposures

# Copied byte for byte: the cameras, and the files that SIBR's viewer and `load_ply` of 3DGS read.
COMPANIONS = ("cameras.json", "input.ply", "exposure.json")

# Pipeline options are not in cfg_args.
ANTIALIASING = (
    "it is taken to be trained with the classic screen filter; 3DGS has had an option --antialiasing since October 2024, which no file records:"
    " if it was on, say so (--screen-filter antialiased)"
)

# Options that determine the screen filter (`_screen_filter`).
FILTER_OPTIONS = ("kernel_size", "load_allres")

# 3DGS interprets iteration 0 as "nothing loaded" (scene/__init__.py), so a model without an iteration gets the usual last one.
DEFAULT_ITERATION = 30_000


def read_options(folder: Path | None) -> tuple[dict[str, Any], list[str]]:
    """The options of the folder's cfg_args, {} if there are none, and a note if some cannot be read."""
    if folder is None or not (folder / "cfg_args").is_file():
        return {}, []
    try:
        options, rest = read_cfg_args_and_rest(folder / "cfg_args")
        return options, [f"cfg_args: {', '.join(rest)} cannot be read and count as not given; the other options are taken"] if rest else []
    except CheckpointError as error:
        return {}, [f"the training options are not known: {error}"]


def trained_scale(options: dict[str, Any], comments: Sequence[str] = ()) -> TrainedScale:
    """How the checkpoint was trained, from its options and the screen filter that its header's comments name, if any."""
    resolution, white = options.get("resolution"), options.get("white_background")
    if not _is_number(resolution):
        resolution = TrainedScale.resolution
    screen_filter, eps2d = recorded_filter(comments) or _screen_filter(options, render_mode(comments))
    return TrainedScale(
        screen_filter=screen_filter,
        eps2d=eps2d,
        resolution=resolution,
        background=(float(white),) * 3 if isinstance(white, bool) else None,
    )


def _is_number(value: Any) -> TypeGuard[float]:
    """Whether an option is a number within the range of float32; a literal may have any number of digits."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e38


def _screen_filter(options: dict[str, Any], tag: str | None) -> tuple[str, float]:
    """Name and dilation of the screen filter. Mip-Splatting and its successors save a kernel_size; Analytic-Splatting has load_allres only."""
    kernel_size = options.get("kernel_size")
    if tag != "classic" and _is_number(kernel_size) and kernel_size >= 0:
        return "mip", float(kernel_size)
    if tag is None and "load_allres" in options and kernel_size is None:
        return "analytic", 0.0
    return tag or TrainedScale.screen_filter, TrainedScale.eps2d


def companion_notes(options: dict[str, Any], sh_degree: int, exposures: Exposures, taken_as_classic: bool) -> list[str]:
    """Remarks on unusual options, in sentences. `taken_as_classic`: no file names the screen filter."""
    notes = []
    if options.get("sh_degree", sh_degree) != sh_degree:
        notes.append(f"cfg_args says SH degree {options['sh_degree']}, but the PLY holds degree {sh_degree}; the PLY is trusted")
    if options.get("train_test_exp"):
        notes.append("trained with train_test_exp: the original shows each view by its exposure, which is done here only where asked for")
    if exposures is not NO_EXPOSURES:
        notes.append(exposures.summary())
    if "train_test_exp" in options and taken_as_classic:
        notes.append(ANTIALIASING)
    return notes


def write_folder(target: Path, source: Path | None, cfg_args: str, iteration: int | None, overwrite: bool, write_ply: Callable[[Path], Any]) -> Path:
    """Write a model folder around the PLY that `write_ply` writes, atomically; return that PLY's path. Raises OutputExists."""
    within = Path("point_cloud", f"iteration_{iteration or DEFAULT_ITERATION}", "point_cloud.ply")
    with new_folder(target, overwrite) as fresh:
        (fresh / within).parent.mkdir(parents=True)
        write_ply(fresh / within)
        (fresh / "cfg_args").write_text(cfg_args, **ENCODING, newline="")
        for name in COMPANIONS:
            if source is not None and (source / name).is_file():
                shutil.copyfile(source / name, fresh / name)
    return target / within


def cfg_args_for(source: Path | None, target: Path, trained: TrainedScale, sh_degree: int) -> str:
    """The text of the new cfg_args: the source's own if SH degree and screen filter agree, else its options, or the defaults of 3DGS.

    Options that determine another screen filter are left out, because readers of the folder would use it.
    """
    options, _ = read_options(source)
    fits = not any(name in options for name in FILTER_OPTIONS) or _screen_filter(options, None) == (trained.screen_filter, trained.eps2d)
    options = {name: value for name, value in options.items() if fits or name not in FILTER_OPTIONS}
    if fits and source is not None and options.get("sh_degree") == sh_degree:
        return cfg_args_text(source / "cfg_args")
    white = trained.background == (1.0, 1.0, 1.0)
    return format_cfg_args({**usual_options(target, trained), "white_background": white, **options, "sh_degree": sh_degree})


def usual_options(target: Path, trained: TrainedScale) -> dict[str, Any]:
    """The options of a model folder at `target` that has none. Whether views were held out (`eval`) is None, not known: no --eval to 3DGS."""
    return {"source_path": "", "model_path": str(target), "images": "images", "resolution": trained.resolution, "data_device": "cuda", "eval": None}
