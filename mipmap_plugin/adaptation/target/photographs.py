"""Photographs as the truth of a zoom-in, where the user has them: they show more detail than the base that was trained on them."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.scenes import Scene


class Photographs:
    """The training images of a scene at the pixel density of the base, and their cameras."""

    def __init__(self, scene: Scene, base: Camera | None, background: tuple[float, float, float]) -> None:
        """`base`: any camera of the base scale. Raises SettingsError if it is None, and for a scene without training images."""
        if base is None:
            raise SettingsError("the checkpoint has no cameras, so that the scale of the images is not known; give its model folder")
        self._scene, self._background = scene, background
        self._originals = {at_density_of(camera, base): camera for camera in scene.split("train") if camera in scene.images}
        if not self._originals:
            raise SettingsError(f"{scene.source}: there are no training images to adapt to; leave them out, or give the folder that has them")
        self.cameras = list(self._originals)

    def note(self, views: Sequence[Camera]) -> str:
        """How many of the views have a photograph. Raises SettingsError if none has."""
        count = sum(view in self._originals for view in views)
        if not count:
            raise SettingsError("none of the views that are adapted to has a photograph: take the train views, or leave the images out")
        return f"{count} of them real images"

    def __call__(self, view: Camera) -> Tensor | None:
        """Return the image [H, W, 3] of one of `cameras`, shrunk as Pillow does; None for any other view."""
        if view not in self._originals:
            return None
        return resize(self._scene.image(self._originals[view], self._background), view.size, "pil-bicubic").clamp(0, 1)


def at_density_of(camera: Camera, base: Camera) -> Camera:
    """`camera` at the pixel density of `base`, as a view of the base scale (its `zoom` stays)."""
    ratio = base.fx / camera.fx
    return camera.resized(max(1, round(camera.width * ratio)), max(1, round(camera.height * ratio)))
