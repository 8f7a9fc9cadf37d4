"""gsplat: the ckpt_*.pt of its simple_trainer, alone or in a result folder; every rank of a run on several GPUs."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import CheckpointError, SceneError, ShapeError, warn
from mipmap_plugin.formats.atomic import new_folder, sha256
from mipmap_plugin.formats.tags import render_mode
from mipmap_plugin.formats.torch_file import load_torch, save_torch, step_and_comments
from mipmap_plugin.formats.yaml_scalars import read_scalars, with_scalar
from mipmap_plugin.models.base import OF_3DGS, TrainedScale
from mipmap_plugin.models.detect import detect
from mipmap_plugin.models.gsplat.frame import normalized_frame
from mipmap_plugin.models.hosts import Capture, held_out
from mipmap_plugin.models.places import GSPLAT
from mipmap_plugin.models.reading import as_tagged, without_invalid
from mipmap_plugin.models.surfels import NOTE as FLAT_NOTE
from mipmap_plugin.models.surfels import SurfelModel, flat_trained
from mipmap_plugin.models.vanilla import Origin, VanillaModel

PLACE, FILE = GSPLAT

# World units, the trainer's default.
NEAR_PLANE = 0.01

# simple_trainer turns its scenes so that they are least extended along z, and most points lie low (`normalize_world_space`).
UP = (0.0, 0.0, 1.0)

UNKNOWN = (
    "cfg.yml is not beside the checkpoint, so that it is taken to be trained with the classic screen filter, and not by the trainer of flat"
    " splats (2DGS), whose files look the same; if it was trained antialiased, say so (--screen-filter antialiased)"
)

SIZE_UNKNOWN = (
    "x1 is taken to be the size of the cameras, but gsplat's trainer shrinks photographs by data_factor, 4 by default, which only its cfg.yml tells:"
    " give the result folder with that file, or for splats in memory the trainer's own cameras (Camera.of_matrices)"
)

# Larger numbers overflow float32; a text may have any number of digits.
MAX_OPTION = 1e38


@dataclass(frozen=True, eq=False)
class GsplatHost:
    """The contents of a gsplat checkpoint other than its splats."""

    family = "gsplat"
    folder: Path | None = None  # the result folder
    options: dict[str, Any] = field(default_factory=dict)  # of its cfg.yml
    siblings: dict[str, Any] = field(default_factory=lambda: {"step": 0})  # of "splats" in the file: the step, poses, ...
    means: str = "means"  # name of the means in the file; "means3d" in gsplat 1.0.0

    def write(self, path: Path, parameters: dict[str, Tensor], comments: Sequence[str], *, overwrite: bool) -> Path:
        """Write one .pt file, or a result folder with the cfg of the source; return the .pt file. Raises OutputExists."""
        splats = {self.means if name == "means" else name: tensor.detach().cpu() for name, tensor in parameters.items()}
        content = {**self.siblings, "splats": splats, "comments": list(comments)}
        if path.suffix == ".pt":
            return save_torch(path, content, overwrite=overwrite)
        within = Path(PLACE, f"ckpt_{self.siblings['step']}_rank0.pt")
        with new_folder(path, overwrite) as fresh:
            save_torch(fresh / within, content, overwrite=False)
            self._write_options(fresh, antialiased=render_mode(comments) == "antialiased")
        return path / within

    def holds(self, path: Path) -> str | None:
        return None if path.suffix == ".pt" else PLACE

    def as_trained(self, cameras: Sequence[Camera], capture: Capture, means: Tensor) -> list[Camera]:
        """The cameras resized by `data_factor`, in the normalized frame, which is recomputed from the cameras and points.

        Those of which `test_every` tells are for testing. Warns where no options tell of these.
        """
        if not self.options:
            warn(SIZE_UNKNOWN)
        points, resized = capture.points, _shrunk(self._split(cameras), int(_positive(self.options, "data_factor", 1)), capture)
        if not self.options.get("normalize_world_space", True):  # always on before version 1.4, which had no such option
            return resized
        if points is None:
            advice = "give the COLMAP scene that it was trained on"
            own = "if its cameras are in the frame of the splats, the cfg.yml of its result folder has to say normalize_world_space: false"
            if self.folder is None:  # a live one has no such file
                own += ", or give wrap_model the cameras themselves (load_scene(path).cameras)"
            raise SceneError(f"gsplat trained in a normalized coordinate frame, which is computed from the points of COLMAP: {advice}; {own}")
        frame = normalized_frame(cameras, points, means)
        return [camera.moved(frame) for camera in resized]

    def _split(self, cameras: Sequence[Camera]) -> Sequence[Camera]:
        every = self.options.get("test_every")
        return held_out(cameras, range(0, len(cameras), every)) if type(every) is int and every > 0 else cameras

    def _write_options(self, folder: Path, *, antialiased: bool) -> None:
        source = _options_file(self.folder)
        if source is None:
            return
        text = source.read_text(encoding="utf-8")
        if source.suffix == ".json":
            text = json.dumps({**json.loads(text), "antialiased": antialiased}, indent=4)
        else:
            text = with_scalar(text, "antialiased", str(antialiased).lower())
        (folder / source.name).write_text(text, encoding="utf-8")


def load_gsplat(path: str | Path, *, iteration: int | None = None) -> VanillaModel:
    """Load a .pt file with all ranks of its step, or the newest step (or step `iteration`) of a result folder. Raises CheckpointError."""
    checkpoint = detect(path, iteration=iteration)
    files = rank_files(checkpoint.path)
    shards = [_read(file) for file in files]
    options, notes = _options(checkpoint.folder)
    means = "means3d" if "means3d" in shards[0]["splats"] else "means"
    siblings = {name: value for name, value in shards[0].items() if name not in ("splats", "comments", "step")}
    step, comments = step_and_comments(shards[0], files[0])
    host = GsplatHost(checkpoint.folder, options, {"step": step, **siblings}, means)
    origin = Origin(files[0], sha256(*files), checkpoint.folder, checkpoint.iteration, comments, host=host)
    parts = [_parameters(shard["splats"], file) for shard, file in zip(shards, files, strict=True)]
    try:
        parameters = {name: torch.cat([part[name] for part in parts]) for name in OF_3DGS}
        flat = str(options.get("model_type", "")).startswith("2dgs")
        trained = _trained(options)
        kind, trained = (SurfelModel, flat_trained(trained)) if flat else (VanillaModel, as_tagged(trained, comments))
        model = kind(parameters, trained, origin, [*notes, *[FLAT_NOTE] * flat])
    except (ShapeError, RuntimeError) as error:  # what torch.cat raises for ranks that do not fit together
        raise CheckpointError(f"{checkpoint.path} holds tensors that do not fit together: {error}; copy it again") from error
    if len(files) > 1:
        model.notes.append(f"the splats of {len(files)} ranks are put together: {', '.join(file.name for file in files)}")
    model.notes += _unusual_options(options, siblings, model.sh_degree)
    return without_invalid(model)


def rank_files(path: Path) -> list[Path]:
    """The files of the same step as `path`, in the order of their ranks. Raises CheckpointError if a rank in between is missing."""
    name = re.fullmatch(FILE, path.name)
    if not name or name["rank"] is None:
        return [path]
    siblings = (re.fullmatch(FILE, file.name) for file in path.absolute().parent.iterdir())
    ranks = {int(file["rank"]): path.with_name(file.string) for file in siblings if file and file["rank"] and file["step"] == name["step"]}
    if len(ranks) <= max(ranks):
        missing = next(rank for rank in count() if rank not in ranks)
        raise CheckpointError(f"{path} is one of the files of several GPUs, and rank {missing} of step {name['step']} is missing; copy it there")
    return [ranks[rank] for rank in sorted(ranks)]


def _read(path: Path) -> dict[str, Any]:
    content = load_torch(path)
    if not isinstance(content, dict) or not isinstance(content.get("splats"), Mapping):
        raise CheckpointError(f"{path} is no gsplat checkpoint: it has no dictionary of splats; give a ckpt_*.pt of simple_trainer")
    return content


def _parameters(splats: Mapping[str, Tensor], path: Path) -> dict[str, Tensor]:
    """The tensors with the names of current gsplat versions, float32. Raises CheckpointError."""
    named = {"means" if name == "means3d" else name: tensor for name, tensor in splats.items()}
    if {"features", "colors"} & set(named):
        advice = "train without app_opt, or export a PLY from gsplat (save_ply), which bakes one appearance"
        raise CheckpointError(f"{path} was trained with app_opt: a network of gsplat colors its splats, which is not read here; {advice}")
    if set(named) != set(OF_3DGS):
        raise CheckpointError(f"{path} holds the splat tensors {', '.join(map(str, named))}; expected are {', '.join(OF_3DGS)}")
    if wrong := [name for name, value in named.items() if not torch.is_tensor(value)]:
        raise CheckpointError(f"{path}: {', '.join(wrong)} should be tensors; save the checkpoint again as gsplat's simple_trainer does")
    return {name: named[name].detach().float() for name in OF_3DGS}


def _shrunk(cameras: Sequence[Camera], factor: int, capture: Capture) -> list[Camera]:
    """The cameras as in simple_trainer (examples/datasets/colmap.py): intrinsics divided by `factor`, then multiplied by the size of the
    first photograph of images_<factor> divided by the truncated size. Without photographs, their size is assumed to be rounded, halves up."""
    if factor < 2 or not cameras:
        return list(cameras)
    first = cameras[0]
    assumed = [max(1, int(side / factor + 0.5)) for side in (first.width, first.height)]
    actual = (capture.smaller(factor) if capture.smaller else None) or assumed
    across, down = (size / max(1, whole // factor) for size, whole in zip(actual, (first.width, first.height), strict=True))
    x, y, shrunk = across / factor, down / factor, list[Camera]()
    for camera in cameras:
        width, height = max(1, int(camera.width // factor * across)), max(1, int(camera.height // factor * down))
        shrunk.append(replace(camera, width=width, height=height, fx=camera.fx * x, fy=camera.fy * y, cx=camera.cx * x, cy=camera.cy * y))
    return shrunk


def _options_file(folder: Path | None) -> Path | None:
    return next((folder / name for name in ("cfg.yml", "cfg.json") if (folder / name).is_file()), None) if folder else None


def _options(folder: Path | None) -> tuple[dict[str, Any], list[str]]:
    """The options of the training, and a note where they are not known. Raises CheckpointError."""
    file = _options_file(folder)
    if file is None:
        return {}, [UNKNOWN]
    try:
        options = json.loads(file.read_text(encoding="utf-8")) if file.suffix == ".json" else read_scalars(file)
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{file} is not JSON ({error}); copy it again, or remove it") from error
    if not isinstance(options, dict):
        raise CheckpointError(f"{file} holds no options by name; copy it again, or remove it")
    return options, []


def _trained(options: dict[str, Any]) -> TrainedScale:
    screen_filter = "antialiased" if options.get("antialiased") else "classic"
    resolution, near = _positive(options, "data_factor", TrainedScale.resolution), _positive(options, "near_plane", NEAR_PLANE)
    up = UP if options.get("normalize_world_space", True) else None
    return TrainedScale(screen_filter, resolution=resolution, near_plane=near, up=up)


def _positive(options: dict[str, Any], key: str, default: float) -> float:
    value = options.get(key)
    return value if isinstance(value, (int, float)) and 0 < value < MAX_OPTION else default


def _unusual_options(options: dict[str, Any], siblings: dict[str, Any], sh_degree: int) -> list[str]:
    notes = []
    if options.get("sh_degree", sh_degree) != sh_degree:
        notes.append(f"the cfg says SH degree {options['sh_degree']}, but the splats have degree {sh_degree}; the splats are trusted")
    if "pose_adjust" in siblings:
        notes.append("the training moved its cameras (pose_opt); the cameras of the scene are rendered as they are given")
    if on := [name for name in ("with_ut", "with_eval3d") if options.get(name) is True]:
        notes.append(f"trained with {', '.join(on)} (3DGUT), which projects splats otherwise than here (EWA); views differ a little from gsplat's")
    if options.get("use_bilateral_grid") is True or options.get("post_processing") not in (None, False, "none"):
        notes.append("trained with a bilateral grid or another correction of colors for each training view, which is not applied here")
    if options.get("camera_model", "pinhole") != "pinhole":
        notes.append(f"trained with {options['camera_model']} cameras; here all cameras are pinholes")
    return notes
