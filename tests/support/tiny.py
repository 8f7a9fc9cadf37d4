"""A scene that adapts in a moment: a ball of splats, the cameras around it, and the checkpoint that holds both."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from orbiting import orbit

from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.formats.images import write_image
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.wrap import Wrapped, wrap_model

WIDTH, HEIGHT = 32, 24  # px


def gaussians(count: int = 60, degree: int = 1, seed: int = 0, spread: float = 0.5) -> Gaussians:
    """Thin, bright, half-opaque splats around the origin, float32. `spread`: world units."""
    rng = torch.Generator().manual_seed(seed)
    scales = 0.015 + 0.15 * torch.rand(count, 3, generator=rng) ** 3
    opacities = 0.3 + 0.65 * torch.rand(count, generator=rng)
    sh = 1.5 * torch.rand(count, (degree + 1) ** 2, 3, generator=rng)
    sh[:, 1:] *= 0.1
    return Gaussians(spread * torch.randn(count, 3, generator=rng), torch.randn(count, 4, generator=rng), scales, opacities, sh)


def with_bands(used: int, room: int) -> Gaussians:
    """Splats with room for SH of degree `room`, of which the bands above `used` are zero."""
    splats = gaussians(10, degree=room)
    splats.sh[:, (used + 1) ** 2 :] = 0
    return splats


def model(count: int = 60, trained: TrainedScale = TrainedScale(), **options) -> VanillaModel:  # noqa: B008
    return VanillaModel.from_gaussians(gaussians(count, **options), trained)


def wrapped(splats: Gaussians, backend: str = "reference", **trained) -> Wrapped:
    """Plain 3DGS of `splats`, with one camera; `trained`: of `TrainedScale`."""
    return wrap_model(VanillaModel.from_gaussians(splats, TrainedScale(**trained)), cameras=cameras(1), backend=backend)


def cameras(count: int = 4, seed: int = 1, split: str = "train", width: int = WIDTH, height: int = HEIGHT) -> list[Camera]:
    """Views of the ball from all around."""
    views = orbit(gaussians(), (height, width), count, torch.Generator().manual_seed(seed), up=(0, 0, 1))
    return [replace(view, name=f"view_{index}", split=split) for index, view in enumerate(views)]


def ply(path: Path, **options) -> Path:
    """A bare PLY, without cameras."""
    return model(**options).save(path, provenance={})


def folder(path: Path, views: list[Camera] | None = None, **options) -> Path:
    """A model folder, with the cameras beside the splats."""
    model(**options).save(path, provenance={})
    write_cameras(path / "cameras.json", views or cameras())
    return path


def scene(path: Path, test: list[Camera] | None = None, train: list[Camera] | None = None, **options) -> Path:
    """A transforms scene with photographs, which are exact renders of the model at the size of each camera."""
    splats = model(**options)
    for split, views in (("train", train or []), ("test", test or cameras(2, seed=9, split="test"))):
        write_photographs(path, split, views, lambda view: ReferenceBackend().render(splats.gaussians(view), view, Effects(1)).image)
    return path


def write_photographs(path: Path, split: str, views: list[Camera], draw: Callable[[Camera], torch.Tensor]) -> None:
    """The photographs of a part of a transforms scene, and their cameras; none without views."""
    frames = []
    for view in views:
        pose = torch.linalg.inv(view.viewmat) @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        frames.append({"file_path": f"./{split}/{view.name}", "transform_matrix": pose.tolist(), "fl_x": view.fx, "fl_y": view.fy})
        write_image(path / split / f"{view.name}.png", draw(view))
    if frames:
        (path / f"transforms_{split}.json").write_text(json.dumps({"frames": frames}))
