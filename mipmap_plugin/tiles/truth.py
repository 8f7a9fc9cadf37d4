"""The pseudo ground truth of a scene on the disk: the base's picture of each whole view, drawn once and resized, for all tiles that show in it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from mipmap_plugin.adaptation.target.image_store import MOST, STEPS
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.camera import Camera
from mipmap_plugin.formats.torch_file import load_torch, save_torch
from mipmap_plugin.tiles.scene import TiledScene

# Views of a file, which one job draws.
VIEWS = 12


def truth_file(folder: Path, part: int) -> Path:
    """The file of the `part`-th views."""
    return folder / f"truth_{part}.pt"


def parts(views: Sequence[Camera]) -> int:
    """The number of files for these views."""
    return -(-len(views) // VIEWS)


def draw_truths(scene: TiledScene, part: int, folder: Path) -> None:
    """Draw the `part`-th views, and write them to their file in `folder`, in 16 bits."""
    views = scene.views.all[part * VIEWS : (part + 1) * VIEWS]
    images = {view.name: (draw_truth(scene, view) * STEPS).round().clamp(-MOST, MOST).to(torch.int16) for view in views}
    save_torch(truth_file(folder, part), images, overwrite=True)


def draw_truth(scene: TiledScene, view: Camera) -> Tensor:
    """The pseudo ground truth [h, w, 3] of a view at the new scale (as `target.pseudo_truth`, for splats on the disk)."""
    config = scene.config
    fraction = 1.0 if config.truth_oversampling is None else min(1.0, config.truth_oversampling * scene.scale)
    camera = view.resized(max(1, round(view.width * fraction)), max(1, round(view.height * fraction)))
    effects = replace(scene.base_effects, eps2d=scene.base_effects.eps2d * fraction**2)
    image = scene.painter(effects).image(scene.base, camera).clamp(0, 1)
    scene.base.release()
    target = resize(image, view.zoomed(scene.scale).size, config.resize)
    return target.clamp(0, 1).mul(255).round().div(255) if config.quantize_truth else target


class Truths:
    """The truths of some views, each within a box of it."""

    def __init__(self, folder: Path, boxes: dict[str, tuple[int, int, int, int] | None]) -> None:
        """`boxes`: by the name of a view, (left, top, right, bottom) in target pixels; None for the whole view."""
        self._images: dict[str, Tensor] = {}
        for part in sorted({int(name) // VIEWS for name in boxes}):
            images = load_torch(truth_file(folder, part))
            for name in images.keys() & boxes.keys():
                left, top, right, bottom = boxes[name] or (0, 0, images[name].shape[1], images[name].shape[0])
                self._images[name] = images[name][top:bottom, left:right].clone()

    @classmethod
    def whole(cls, folder: Path, views: Iterable[Camera]) -> Truths:
        """The truths of whole views."""
        return cls(folder, {view.name: None for view in views})

    def __call__(self, view: Camera) -> Tensor:
        """The truth [h, w, 3] of a view."""
        return self._images[view.name].float() / STEPS
