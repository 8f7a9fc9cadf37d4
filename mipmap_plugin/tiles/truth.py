"""The pseudo ground truth of a scene on the disk: the base's picture of each whole view, drawn once and resized, for all tiles and scales."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack

from torch import Tensor

from mipmap_plugin.adaptation.target.base_images import facts
from mipmap_plugin.adaptation.target.image_store import from_16_bits, in_16_bits
from mipmap_plugin.adaptation.target.pseudo_truth import quantized, resolution
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.camera import Camera
from mipmap_plugin.tiles.folder import truth_file
from mipmap_plugin.tiles.pictures import Album, new_pictures
from mipmap_plugin.tiles.scene import TiledScene

# Views of a file, which one job draws.
VIEWS = 12


def parts(views: Sequence[Camera]) -> int:
    """The number of files for these views."""
    return -(-len(views) // VIEWS)


def part_of(views: Sequence[Camera], number: int) -> Sequence[Camera]:
    """The views of one file."""
    return views[number * VIEWS : (number + 1) * VIEWS]


def draw_truths(scene: TiledScene, part: int, others: Sequence[TiledScene] = ()) -> None:
    """Draw the `part`-th views, and write them to their file, in 16 bits.

    `others`: the same scene at further scales. The part is written for them too if it has the same views there.
    """
    views = part_of(scene.used_views, part)
    sharing = [scene, *(other for other in others if _shares(scene, other, part))]
    with ExitStack() as files:  # the first file, its own, is closed last: it says that all are there
        writers = [(each, files.enter_context(new_pictures(truth_file(each.folder, part)))) for each in sharing]
        for view in views:
            image = draw_base(scene, view)
            for each, write in writers:
                write(view.name, in_16_bits(resized(each, view, image)), None)


def _shares(scene: TiledScene, other: TiledScene, part: int) -> bool:
    """Whether the truths of a part follow from the same pictures of the base."""
    names_and_facts = [[(view.name, facts(view)) for view in part_of(each.used_views, part)] for each in (scene, other)]
    return _fraction(scene) == _fraction(other) and names_and_facts[0] == names_and_facts[1]


def draw_base(scene: TiledScene, view: Camera) -> Tensor:
    """The base's picture of a view, from splats on the disk, with the pixels that its truth is made from."""
    fraction = _fraction(scene)
    size = (max(1, round(pixels * fraction)) for pixels in (view.width, view.height))
    return scene.base_painter(fraction).image(scene.base, view.resized(*size)).clamp(0, 1)


def resized(scene: TiledScene, view: Camera, image: Tensor) -> Tensor:
    """The pseudo ground truth [h, w, 3] of a view at the new scale, from the base's picture of it."""
    return quantized(resize(image, view.zoomed(scene.scale).size, scene.config.resize), scene.config)


def _fraction(scene: TiledScene) -> float:
    """The fraction of the base scale at which the base is drawn."""
    return resolution(scene.config, scene.scale)


class Truths:
    """The truths of all views that are used, on the disk."""

    def __init__(self, scene: TiledScene) -> None:
        self._album = Album(truth_file(scene.folder, part) for part in range(parts(scene.used_views)))

    def __getitem__(self, name: str) -> Tensor:
        """The truth [h, w, 3] of the whole view of this name."""
        return from_16_bits(self._album[name])
