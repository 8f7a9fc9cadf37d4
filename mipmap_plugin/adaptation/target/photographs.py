"""Photographs as the truth of a zoom-in, where the user has them: they show more detail than the base that was trained on them."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from mipmap_plugin.adaptation.target.other_world import LOOK, doubt_about
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.warn import warn
from mipmap_plugin.backends.base import Rendered
from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SettingsError, type_of
from mipmap_plugin.limits import path_of
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.models.inria_folder import read_options
from mipmap_plugin.scenes import Scene, load_photographs
from mipmap_plugin.scenes.base import SHAPE_TOLERANCE
from mipmap_plugin.scenes.listed_images import stem_of, without_suffix


class Photographs:
    """The training images of a scene at the pixel density of the base, and their cameras."""

    def __init__(self, scene: Scene, base: Sequence[Camera], background: tuple[float, float, float]) -> None:
        """`base`: the cameras of the base. Raises SettingsError if it has none, and for a scene without training images."""
        if not base:
            remedy = "give its model folder, or its cameras (--cameras)"
            raise SettingsError(f"the checkpoint has no cameras, so that the scale of the images is not known; {remedy}")
        self._scene, self._background = scene, background
        originals = [camera for camera in scene.split("train") if camera in scene.images]
        self._originals = dict(zip(at_density_of([*map(scene.as_photographed, originals)], base), originals, strict=True))
        if not self._originals:
            raise SettingsError(f"{scene.source}: there are no training images to adapt to; leave them out, or give the folder that has them")
        self.cameras = list(self._originals)
        for view, original in self._originals.items():
            if (size := scene.image_size(original))[0] < (1 - SHAPE_TOLERANCE) * view.width:
                remedy = f"give larger photographs, or leave them out, or, if it was trained on these, add --cameras {scene.source}"
                small = f"{scene.images[original]} has {size[0]} x {size[1]} px, but the base was trained at {view.width} x {view.height} px"
                raise SettingsError(f"{small}: made larger, it shows less than the base; {remedy}")

    def note(self, views: Sequence[Camera]) -> str:
        """How many of the views have a photograph. Raises SettingsError if none has."""
        count = sum(view in self._originals for view in views)
        if not count:
            raise SettingsError("none of the views that are adapted to has a photograph: take the train views, or leave the images out")
        return f"{count} of them real images"

    def warn_of_others(self, render: Callable[..., Rendered], compared: set[tuple[Path, bytes]]) -> None:
        """Warn if the base, by its `render`, does not show what they do (`doubt_about`), unless it was `compared` with them; that is noted there."""
        if self._scene.photographed() <= compared:
            return
        compared |= self._scene.photographed()
        scene, color, originals = self._scene, self._background, self._originals
        if doubt := doubt_about(self.cameras, lambda view: scene.image(originals[view], color, LOOK), render, color, "--images"):
            warn(doubt)

    def __call__(self, view: Camera) -> Tensor | None:
        """Return the image [H, W, 3] of one of `cameras`, shrunk as Pillow does; None for any other view."""
        if view not in self._originals:
            return None
        return resize(self._scene.image(self._originals[view], self._background), view.size, "pil-bicubic").clamp(0, 1)


def at_density_of(cameras: Sequence[Camera], base: Sequence[Camera]) -> list[Camera]:
    """The cameras as views of the base scale (their `zoom` stays): each at the pixel density of the base's view of that name.

    Cameras that the base does not have get the density of those of the most similar field of view: trainings shrink images of other sizes
    by other factors, such as upright and wide ones of the same lens to the same width. The principal point is in the middle where that of the base's
    view is: 3DGS takes it to be there whatever the scene says, and the base shows its scene so. A training view's number is that of the base's view
    (`Camera.index`), so that it keeps its own appearance.
    """
    kinds, named = {(*view.size, view.fx, view.fy): view for view in base}, defaultdict[str, list[Camera]](list)
    for view in base:
        for name in names_of(view):
            named[name].append(view)  # several, where images of several folders have the same names
    similar, similar_of_name = MostSimilar(list(kinds.values())), {name: MostSimilar(views) for name, views in named.items()}

    def at_density(camera: Camera) -> Camera:
        name = next((name for name in names_of(camera) if name in named), "")
        own, view = named.get(name, []), similar_of_name.get(name, similar)(camera)
        # Each side by itself: where the base's view is of the same field, the size is that of its training, however that was rounded.
        sides = (camera.width * view.fx / camera.fx, camera.height * view.fy / camera.fy)
        resized = camera.resized(*(max(1, round(side)) for side in sides))
        if camera.index is None and len(own) == 1 and view.split == camera.split:
            resized = replace(resized, index=view.index)
        centered = math.isclose(2 * view.cx, view.width) and math.isclose(2 * view.cy, view.height)  # but for rounding
        return replace(resized, cx=resized.width / 2, cy=resized.height / 2) if centered else resized

    return [*map(at_density, cameras)]


def names_of(camera: Camera) -> tuple[str, ...]:
    """The names by which a view and its photograph are the same: with folders and, for 3DGS left these out until October 2024, without."""
    return tuple(dict.fromkeys((without_suffix(camera.name), stem_of(camera.name))))


class MostSimilar:
    """Finds among views the one whose field of view differs least along both axes: by the sum of the logarithms of its ratios.

    It compares with all at once, for each of 10,000 cameras may have a lens of its own.
    """

    def __init__(self, views: Sequence[Camera]) -> None:
        self._views = views
        self._fields = torch.tensor([_field(view) for view in views], dtype=torch.float64)

    def __call__(self, camera: Camera) -> Camera:
        return self._views[int((self._fields - self._fields.new_tensor(_field(camera))).abs().sum(1).argmin())]


def _field(camera: Camera) -> tuple[float, float]:
    """The field of view along both axes, by the logarithm of the picture's size in focal lengths."""
    return math.log(camera.width / camera.fx), math.log(camera.height / camera.fy)


def scene_of(model: SplatModel, images: Scene | str | Path) -> Scene:
    """The scene, or that at a path, with the options of the model's training. Raises SceneError, and SettingsError for anything else."""
    if isinstance(images, Scene):
        return images
    if not isinstance(images, (str, Path)):
        raise SettingsError(f"images must be the path of the photographs' scene, or a Scene, got {type_of(images)}")
    return load_photographs(path_of(images, "images"), read_options(model.folder)[0])
