"""The pseudo ground truth of a scene on the disk: the base's picture of each whole view, drawn once and resized, for all tiles that show in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from mipmap_plugin.adaptation.target.image_store import MOST, STEPS
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.camera import Camera
from mipmap_plugin.tiles.folder import truth_file
from mipmap_plugin.tiles.pictures import Album, write_pictures
from mipmap_plugin.tiles.scene import TiledScene

# Views of a file, which one job draws.
VIEWS = 12


def parts(views: Sequence[Camera]) -> int:
    """The number of files for these views."""
    return -(-len(views) // VIEWS)


def part_of(views: Sequence[Camera], number: int) -> Sequence[Camera]:
    """The views of one file."""
    return views[number * VIEWS : (number + 1) * VIEWS]


def draw_truths(scene: TiledScene, part: int, folder: Path) -> None:
    """Draw the `part`-th views, and write them to their file in `folder`, in 16 bits."""
    views = part_of(scene.used_views, part)
    write_pictures(truth_file(folder, part), ((view.name, in_16_bits(draw_truth(scene, view)), None) for view in views))


def draw_truth(scene: TiledScene, view: Camera) -> Tensor:
    """The pseudo ground truth [h, w, 3] of a view at the new scale (as `target.pseudo_truth`, for splats on the disk)."""
    config = scene.config
    fraction = 1.0 if config.truth_oversampling is None else min(1.0, config.truth_oversampling * scene.scale)
    camera = view.resized(max(1, round(view.width * fraction)), max(1, round(view.height * fraction)))
    effects = replace(scene.base_effects, eps2d=scene.base_effects.eps2d * fraction**2)
    image = scene.painter(effects).image(scene.base, camera).clamp(0, 1)
    target = resize(image, view.zoomed(scene.scale).size, config.resize)
    return target.clamp(0, 1).mul(255).round().div(255) if config.quantize_truth else target


def in_16_bits(image: Tensor) -> Tensor:
    """An image as it is stored (`image_store`)."""
    return (image * STEPS).round().clamp(-MOST, MOST).to(torch.int16)


def from_16_bits(stored: Tensor) -> Tensor:
    """An image that was stored."""
    return stored.float() / STEPS


class Truths:
    """The truths of all views that are used, on the disk."""

    def __init__(self, scene: TiledScene, folder: Path) -> None:
        self._album = Album(truth_file(folder, part) for part in range(parts(scene.used_views)))

    def __call__(self, view: Camera) -> Tensor:
        """The truth [h, w, 3] of a whole view, which is found by its name."""
        return self.named(view.name)

    def named(self, name: str) -> Tensor:
        """The truth [h, w, 3] of the view of this name."""
        return from_16_bits(self._album[name])
