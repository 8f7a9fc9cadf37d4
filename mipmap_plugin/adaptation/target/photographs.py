"""Real images as the truth of a zoom-in, where a person has them: they were there before the base, and know more than it shows."""

from __future__ import annotations

from torch import Tensor

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.scenes import Scene


class Photographs:
    """The training images of a scene at the pixel density of the base, and the cameras that they belong to."""

    def __init__(self, scene: Scene, base: Camera | None, background: tuple[float, float, float]) -> None:
        """`base`: any camera of the base scale. Raises SettingsError where there is none, and for a scene without training images."""
        if base is None:
            raise SettingsError("the checkpoint has no cameras, so that the scale of the images is not known; give its model folder")
        self._scene, self._background = scene, background
        self._taken_by = {as_sampled(camera, base): camera for camera in scene.split("train") if camera in scene.images}
        if not self._taken_by:
            raise SettingsError(f"{scene.source}: there are no training images to adapt to; leave them out, or give the folder that has them")
        self.cameras = list(self._taken_by)

    def __call__(self, view: Camera) -> Tensor | None:
        """The image [H, W, 3] of one of `cameras`, made smaller as Pillow does; None for any other view."""
        if view not in self._taken_by:
            return None
        return resize(self._scene.image(self._taken_by[view], self._background), view.size, "pil-bicubic").clamp(0, 1)


def as_sampled(camera: Camera, base: Camera) -> Camera:
    """`camera` at the pixel density of `base`: where zooming starts from, and not itself a zoom."""
    ratio = base.fx / camera.fx
    return camera.resized(max(1, round(camera.width * ratio)), max(1, round(camera.height * ratio)))
