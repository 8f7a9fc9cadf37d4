"""splatfacto of nerfstudio: the step-*.ckpt of its trainer, alone or in the folder of a run. Its config is read as text, never executed."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import CheckpointError, OutputError, SceneError, ShapeError, warn
from mipmap_plugin.formats.atomic import new_folder, sha256
from mipmap_plugin.formats.tags import render_mode
from mipmap_plugin.formats.torch_file import load_torch, save_torch, step_and_comments
from mipmap_plugin.formats.yaml_scalars import read_scalars, with_scalar
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.columns import OPACITY_MARGIN
from mipmap_plugin.models.detect import detect
from mipmap_plugin.models.hosts import Capture, as_file, held_out
from mipmap_plugin.models.places import SPLATFACTO
from mipmap_plugin.models.reading import as_tagged, without_invalid
from mipmap_plugin.models.vanilla import Origin, VanillaModel
from mipmap_plugin.splatting.harmonics import C0

PLACE, FILE = SPLATFACTO

# Keys of the splats in a state dict: with gauss_params since version 1.1, with `module` after training on several GPUs.
KEY = r"(?:module\.)?_model\.(?:module\.)?(?:gauss_params\.)?(means|scales|quats|features_dc|features_rest|opacities)"
NAMES = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")

# World units (models/splatfacto.py passes it to gsplat).
NEAR_PLANE = 0.01

# nerfstudio turns its scenes so that the cameras' mean vertical is z (`orientation_method: up`).
UP = (0.0, 0.0, 1.0)

# Background of renders by option `background_color`; after training on "random" colors it is the last one.
BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "random": (0.1490, 0.1647, 0.2157)}

# An option of the dataparser that reads COLMAP's own files, in the order of the images' numbers, which is often not that of their names.
OF_COLMAP = "assume_colmap_world_coordinate_convention"

# px: larger photographs are halved until they fit (data/dataparsers/nerfstudio_dataparser.py).
MAX_SIDE = 1600


@dataclass(frozen=True, eq=False)
class SplatfactoHost:
    """What a splatfacto checkpoint has besides its splats. The file is read again when a new one is written."""

    source: Path
    folder: Path | None = None  # of the run
    step: int = 0
    options: dict[str, Any] = field(default_factory=dict)  # of its config.yml
    family = "splatfacto"

    def write(self, path: Path, parameters: dict[str, Tensor], comments: Sequence[str], *, overwrite: bool) -> Path:
        """Write one .ckpt file, or the folder of a run; return the .ckpt file.

        A copy of the original file in which the splats are replaced and comments are added. The optimizers' moments do not change, so
        training cannot be resumed from it after splats were removed. Raises OutputExists, OutputError.
        """
        if path.suffix == ".ckpt":
            return save_torch(path, self._content(parameters, comments), overwrite=overwrite)
        within = Path(PLACE, f"step-{self.step:09d}.ckpt")
        with new_folder(path, overwrite) as fresh:
            save_torch(fresh / within, self._content(parameters, comments), overwrite=False)
            self._write_companions(fresh, path.name, render_mode(comments) or "classic")
        return path / within

    def holds(self, path: Path) -> str | None:
        if path.suffix != ".ckpt":
            return PLACE
        if path.parent.name == PLACE and not re.fullmatch(FILE, path.name):
            raise OutputError(f"{path}: nerfstudio reads the step from every name in {PLACE}, and would stop at this one; choose another folder")
        return None

    def as_trained(self, cameras: Sequence[Camera], capture: Capture, means: Tensor) -> list[Camera]:
        """Transform the cameras by dataparser_transforms.json, and shrink large images as nerfstudio does. Raises SceneError.

        Those views are for testing that the config holds out, unless it says nothing of that, or a transforms.json has lists of its own.
        """
        names = [camera.name for camera in cameras]
        said = any(camera.split == "test" for camera in cameras) if capture.points is None else "eval_mode" not in self.options
        numbers = capture.numbers if capture.points is None or OF_COLMAP in self.options else ()
        if not said and (numbers or len(set(names)) == len(names)):
            ordered = [name for _, name in sorted(zip(numbers, names, strict=True))] if numbers else sorted(names, key=as_file)
            cameras = held_out(cameras, _tests(ordered, self.options), numbers)
        frame = self._frame()
        frame[:3] /= capture.applied_scale  # contained in the file's scale, but already applied to the poses
        factor = _factor(cameras, self.options.get("downscale_factor"), capture)
        ratio = self.options.get("camera_res_scale_factor")  # the datamanager resizes what the dataparser found
        again = 1 / ratio if isinstance(ratio, (int, float)) and ratio > 0 else 1.0
        return [_shrunk(_shrunk(camera, factor), again).moved(frame) for camera in cameras]

    def _content(self, parameters: dict[str, Tensor], comments: Sequence[str]) -> dict[str, Any]:
        content = load_torch(self.source)
        stored = to_stored(parameters)
        pipeline = {key: stored[name[1]] if (name := re.fullmatch(KEY, str(key))) else value for key, value in content["pipeline"].items()}
        return {**content, "pipeline": pipeline, "comments": list(comments)}

    def _frame(self) -> Tensor:
        """The similarity [4, 4] float64 from the world of the photographs to that of the checkpoint. Raises SceneError."""
        file = (self.folder or self.source.parent) / "dataparser_transforms.json"
        try:
            facts = json.loads(file.read_text(encoding="utf-8"))
            scale, transform = float(facts["scale"]), torch.tensor(facts["transform"], dtype=torch.float64)
        except (OSError, ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
            advice = "without it the cameras of the scene cannot be placed; copy it from the folder of the training"
            raise SceneError(f"{file} cannot be read ({error}): {advice}") from error
        if tuple(transform.shape) != (3, 4) or not scale > 0:
            raise SceneError(f"{file}: expected a 3 x 4 transform and a scale above 0; copy it again from the folder of the training")
        frame = torch.eye(4, dtype=torch.float64)
        frame[:3] = scale * transform
        return frame

    def _write_companions(self, folder: Path, name: str, screen_filter: str) -> None:
        """Copy the config and the transforms. The config refers to its folder by name, as `timestamp`."""
        if self.folder is None:
            return
        if screen_filter != "classic" and self.options and "rasterize_mode" not in self.options:
            warn(f"{folder.name}: its config.yml is of a nerfstudio without rasterize_mode, which draws the splats classic, and not {screen_filter}")
        for file in (self.folder / "config.yml", self.folder / "dataparser_transforms.json"):
            if file.is_file():
                text = file.read_text(encoding="utf-8")
                if file.suffix == ".yml":
                    text = with_scalar(with_scalar(text, "timestamp", json.dumps(name)), "rasterize_mode", screen_filter)
                (folder / file.name).write_text(text, encoding="utf-8")


def load_splatfacto(path: str | Path, *, iteration: int | None = None) -> VanillaModel:
    """Load a .ckpt file, or the newest step (or step `iteration`) of a run's folder. Raises CheckpointError."""
    checkpoint = detect(path, iteration=iteration)
    content = load_torch(checkpoint.path)
    stored = _stored(content, checkpoint.path)
    config = checkpoint.folder / "config.yml" if checkpoint.folder else None
    options = read_scalars(config) if config and config.is_file() else {}
    step, comments = step_and_comments(content, checkpoint.path)
    host = SplatfactoHost(checkpoint.path, checkpoint.folder, step, options)
    origin = Origin(checkpoint.path, sha256(checkpoint.path), checkpoint.folder, checkpoint.iteration, comments, host=host)
    screen_filter = "antialiased" if options.get("rasterize_mode") == "antialiased" else "classic"
    background = BACKGROUNDS.get(str(options.get("background_color")))
    trained = as_tagged(TrainedScale(screen_filter, background=background, near_plane=NEAR_PLANE, up=UP), comments)
    try:
        model = VanillaModel(to_parameters(stored), trained, origin, _unusual_options(content["pipeline"], options))
    except (ShapeError, RuntimeError, IndexError) as error:  # what torch raises for a tensor with too few axes
        raise CheckpointError(f"{checkpoint.path} holds tensors that do not fit together: {error}; copy it again") from error
    return without_invalid(model)


def to_parameters(stored: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Parameters with VanillaModel's names. At SH degree 0 splatfacto stores logits of colors instead of coefficients."""
    raw = {name: tensor.detach().float() for name, tensor in stored.items()}
    dc, rest = raw["features_dc"], raw["features_rest"]
    sh0 = dc if rest.shape[1] else ((dc.double().sigmoid() - 0.5) / C0).float()
    opacities = raw["opacities"].squeeze(1)
    return {"means": raw["means"], "scales": raw["scales"], "quats": raw["quats"], "opacities": opacities, "sh0": sh0[:, None], "shN": rest}


def to_stored(parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The inverse of `to_parameters`; colors are clamped to just inside 0..1, where logits are finite."""
    raw = {name: tensor.detach().cpu() for name, tensor in parameters.items()}
    dc, rest = raw["sh0"].squeeze(1), raw["shN"]
    features_dc = dc if rest.shape[1] else (dc.double() * C0 + 0.5).logit(eps=OPACITY_MARGIN).float()
    attributes = {"means": raw["means"], "scales": raw["scales"], "quats": raw["quats"], "opacities": raw["opacities"][:, None]}
    return {**attributes, "features_dc": features_dc, "features_rest": rest}


def _stored(content: Any, path: Path) -> dict[str, Tensor]:
    pipeline = content.get("pipeline") if isinstance(content, Mapping) else None
    if not isinstance(pipeline, Mapping):
        raise CheckpointError(f"{path} is no checkpoint of nerfstudio: it has no pipeline; give a step-*.ckpt of splatfacto")
    named = ((re.fullmatch(KEY, str(key)), tensor) for key, tensor in pipeline.items())
    stored = {name[1]: tensor for name, tensor in named if name and torch.is_tensor(tensor)}
    if missing := [name for name in NAMES if name not in stored]:
        advice = "it is another method of nerfstudio, or a variant that is not read"
        raise CheckpointError(f"{path} lacks {', '.join(missing)} of splatfacto's splats; {advice}")
    return stored


def _unusual_options(pipeline: Mapping[str, Any], options: dict[str, Any]) -> list[str]:
    notes = []
    if not options:
        advice = "if it was antialiased, say so (--screen-filter antialiased)"
        notes.append(f"config.yml is not beside the checkpoint, so that it is taken to be trained with the classic screen filter; {advice}")
    named = [re.search(r"gauss_params\.(\w+)$", str(key)) for key in pipeline]
    if more := [name[1] for name in named if name and name[1] not in NAMES]:
        stale = "adapted checkpoints keep those of the base, and only open where no splats were merged or left out; --viewer writes a PLY"
        notes.append(f"its splats also have {', '.join(more)}, which splatfacto's have not: {stale}")
    if any(str(key).endswith("camera_optimizer.pose_adjustment") for key in pipeline):
        notes.append("the training moved its cameras (camera_optimizer); the cameras of the scene are rendered as they are given")
    if options.get("use_bilateral_grid"):
        notes.append("trained with a bilateral grid: nerfstudio regrades each training view by its own, which is not applied here")
    return notes


def _tests(names: list[str], options: dict[str, Any]) -> list[int]:
    """The places of the test views among `names` in the training's order (data/utils/dataparsers_utils.py); none if the config does not tell."""
    count, interval, share = len(names), options.get("eval_interval", 8), options.get("train_split_fraction")
    match options.get("eval_mode"):
        case "fraction" if isinstance(share, (int, float)) and 0 < share <= 1:
            return sorted({*range(count)} - {*np.linspace(0, count - 1, math.ceil(count * share), dtype=int).tolist()})
        case "interval" if isinstance(interval, int) and interval > 0:
            return list(range(0, count, interval))
        case "filename":
            return [place for place, name in enumerate(names) if "eval" in name and "train" not in name]
    return []


def _factor(cameras: Sequence[Camera], downscale_factor: Any, capture: Capture) -> float:
    """The factor by which nerfstudio divides all sizes: `downscale_factor`, or the least power of 2 that makes the first photograph fit, as
    far as images_2, images_4, ... exist. Without photographs, these folders are assumed to have existed."""
    if isinstance(downscale_factor, (int, float)) and downscale_factor > 0:
        return downscale_factor
    factor = 1
    while cameras and max(cameras[0].size) / factor > MAX_SIDE and (capture.smaller is None or capture.smaller(2 * factor)):
        factor *= 2
    return factor


def _shrunk(camera: Camera, factor: float) -> Camera:
    """The camera at 1/`factor` of its size. Sizes are truncated to whole pixels, intrinsics are not (cameras.py, rescale_output_resolution)."""
    size = dict(width=max(1, int(camera.width / factor)), height=max(1, int(camera.height / factor)))
    lens = {name: getattr(camera, name) / factor for name in ("fx", "fy", "cx", "cy")}
    return replace(camera, **size, **lens)  # type: ignore[arg-type]
